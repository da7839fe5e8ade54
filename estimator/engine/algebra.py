"""The packed algebra of a filter, as assignments: what a sample does to a joint Gaussian, or to a path.

With M, S, N of a sample (`estimator.engine.derive`) the joint covariance P of states and coefficients is predicted by
Q = S P Sᵀ, and sensors are taken one after another: with h the derivative of what a sensor shows,

    c = Q h,   s = hᵀ Q h,   e = y - prediction,   q = hᵀ N h / E[γ],   r = 1/E[ξ],

for fixed E[γ], E[ξ] a Kalman step; minimising the free energy over q(γ) and q(ξ) needs the moments of both noises under
that step's posterior, which depend on scalars only:

    E[w²] = (q e/S)² + q (1 - q/S),   E[v²] = (r e/S)² + r (1 - r/S),   S = s + q + r.

γ is learned from the first sensor that shows the process noise of the same sample; where none does, γ stays.

Where a sample says 10⁸ times more than was known, rounding may leave a matrix that is not positive semi-definite.
So every variance takes along what rounding may have changed it by, `ROUNDING` of what it is the difference of: the
rounded matrix is the exact one and an error E, |E_ij| ≤ a_i a_j ROUNDING/d, to which ROUNDING diag(a²) is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import sympy as sp

from estimator.engine.derive import Assignments, Lines, Moved, calculus, input_at_end, pair, symbol
from estimator.engine.emit import text_of
from estimator.models.model import Model

ZERO, ONE, HALF = sp.S.Zero, sp.S.One, sp.S.Half

#: What rounding may change a variance by, in parts of its terms: 64 times 2⁻⁵³, for sums of d² = 36 or so products.
ROUNDING = 2.0**-47

#: 1 where a number is there and 0 where it is NaN; and the second of three where the first is positive, else the third.
present, select = sp.Function("present"), sp.Function("select")

#: A number, or 0 where it is negative; and the first of three, or whichever of the others it lies beyond. NaN stays.
rectified, clip = sp.Function("rectified"), sp.Function("clip")


class Gaussian:
    """The predicted joint Gaussian, while sensors are taken: symbols or expressions of its mean and covariance.

    Args:
        model: whose quantities.
        moved: the motion over the sample.
    """

    def __init__(self, model: Model, moved: Moved) -> None:
        self.model, self.moved = model, moved
        self.names, self.states = list(model.names), list(model.states)
        self.lines = Lines()
        self.put = self.lines.put
        if not moved.is_sound:
            self.moved = replace(moved, noise=self._sound(moved.noise))
        self.mean: dict[str, sp.Expr] = {
            **dict(zip(self.states, moved.state, strict=True)),
            **{c: symbol(c) for c in model.coefficients},
        }
        self.cov: dict[tuple[str, str], sp.Expr] = {}
        self.half: dict[str, dict[str, sp.Expr]] = {}  # rows of S P
        self._predict()

    def __getitem__(self, key: tuple[str, str]) -> sp.Expr:
        i, j = key
        return self.cov[(i, j) if self.names.index(i) <= self.names.index(j) else (j, i)]

    def _sound(self, noise: Sequence[Sequence[sp.Expr]]) -> tuple[tuple[sp.Expr, ...], ...]:
        """N where it is positive semi-definite; else its variances, with covariances cut to what they allow.

        N is integrated by steps that are too long for slopes of more than about 3 a step, and may then be anything.
        """
        n = len(noise)
        at = {(a, b): noise[a][b] for a in range(n) for b in range(a, n)}
        for a in range(n):
            at[a, a] = self.put(f"SOUND_{a}_{a}", rectified(at[a, a]))
        rest = dict(at)  # what those before leave of it
        for a in range(n - 1):
            for b in range(a + 1, n):
                largest = self.put(f"LARGEST_{a}_{b}", sp.sqrt(rectified(rest[a, a])) * sp.sqrt(rectified(rest[b, b])))
                kept = self.put(f"KEPT_{a}_{b}", clip(rest[a, b], -largest, largest))
                at[a, b] = self.put(f"SOUND_{a}_{b}", at[a, b] + (kept - rest[a, b])) if a else kept
                rest[a, b] = kept
            inverse = self.put(f"INVERSE_{a}", 1 / select(rest[a, a], rest[a, a], ONE)) if a < n - 2 else ZERO
            for b in range(a + 1, n if a < n - 2 else 0):
                for c in range(b, n):
                    rest[b, c] = self.put(f"REST_{a}_{b}_{c}", rest[b, c] - rest[a, b] * rest[a, c] * inverse)
        return tuple(tuple(at[min(a, b), max(a, b)] for b in range(n)) for a in range(n))

    def _predict(self) -> None:
        """Q = S P Sᵀ, or Q as it is where no S is given: the states' rows change, the coefficients' block stays."""
        names, by, rows = self.names, self.moved.by, self.half
        for a, i in enumerate(names):
            for j in names[a:]:
                self.cov[i, j] = pair("P" if i not in self.states else "Q", i, j, names)
        if not by:
            return
        for i, slopes in zip(self.states, by, strict=True):
            row = {}
            for j in names:
                total = sum((a * pair("P", k, j, names) for k, a in zip(names, slopes, strict=True)), ZERO)
                row[j] = self.put(f"B_{i}_{j}", total)
            rows[i] = row
        n = len(self.states)
        for a, i in enumerate(self.states):
            for b in range(a, n):
                total = sum((s * rows[i][k] for k, s in zip(names, by[b], strict=True)), ZERO)
                if a == b and not total.is_Symbol:
                    terms = (s**2 * pair("P", k, k, names) for k, s in zip(names, by[b], strict=True))
                    total += ROUNDING * sum(terms, ZERO)
                self.cov[i, self.states[b]] = self.put(f"Q_{i}_{self.states[b]}", total)
            for j in names[n:]:
                self.cov[i, j] = rows[i][j]

    def expected(self, sensor: int, degree: int) -> tuple[sp.Expr, list[sp.Expr]]:
        """What a sensor is expected to show, and its derivative h by all quantities, at the mean now."""
        c = calculus(self.model)
        at = {symbol(name): value for name, value in self.mean.items()} | {
            symbol("u"): input_at_end(self.model, degree)
        }
        return c.outputs[sensor].xreplace(at), [slope.xreplace(at) for slope in c.readouts[sensor]]

    def surprise(self, readout: Sequence[sp.Expr], r: sp.Expr) -> sp.Expr:
        """Variance by which the output of the sample before, not seen yet, moves what a sensor is expected to show.

        With P after that output it is (hᵀ S P h)² / (r - hᵀ P h): its gain is P h / r, and its own variance
        r² / (r - hᵀ P h). That is kept above 0, since the P of a belief may be more than an output leaves.
        """
        h = {i: slope for i, slope in zip(self.names, readout, strict=True) if slope != 0}
        before = {(i, j): pair("P", i, j, self.names) for i in h for j in h}
        moved = sum((h[i] * h[j] * (self.half[i][j] if i in self.half else before[i, j]) for i, j in before), ZERO)
        left = self.put("LEFT", r - sum((h[i] * h[j] * known for (i, j), known in before.items()), ZERO))
        least = self.put("LITTLE", ROUNDING * r)
        return self.put("TAKEN", moved) ** 2 / self.put("LEAST", select(left - least, left, least))

    def shown_noise(self, readout: Sequence[sp.Expr]) -> sp.Expr:
        """hᵀ N h: the variance that unit process noise has in a sensor."""
        n = len(self.states)
        total = sum((readout[a] * readout[b] * self.moved.noise[a][b] for a in range(n) for b in range(n)), ZERO)
        return sp.expand(total) if not total.free_symbols else total

    def covariance_with(self, readout: Sequence[sp.Expr], tag: str) -> tuple[dict[str, sp.Expr], sp.Expr]:
        """C = Q h and s = hᵀ c."""
        c = {}
        for i in self.names:
            total = sum((h * self[i, j] for j, h in zip(self.names, readout, strict=True)), ZERO)
            c[i] = self.put(f"C{tag}_{i}", total)
        s = sum((h * c[i] for i, h in zip(self.names, readout, strict=True)), ZERO)
        return c, self.put(f"S{tag}", s)

    def add_noise(self, strength: sp.Expr) -> None:
        """Q + N strength, of the states."""
        for a, i in enumerate(self.states):
            for b in range(a, len(self.states)):
                k, spread = self.states[b], self.moved.noise[a][b]
                if spread != 0:
                    self.cov[i, k] = self.put(f"R_{i}_{k}", self.cov[i, k] + strength * spread)

    def condition(
        self, readout: Sequence[sp.Expr], c: dict[str, sp.Expr], weight: sp.Expr, step: sp.Expr, keep: sp.Expr,
        tag: str, there: sp.Expr = ONE,
    ) -> None:  # fmt: skip
        """Condition on a sensor: mean + c step, Q - c cᵀ weight; ``keep`` is r weight; ``there`` is 0 for no output.

        A quantity that the sensor shows as it is keeps its row times r/S, which cannot become negative by rounding.
        """
        seen = [i for i, h in zip(self.names, readout, strict=True) if h == 1]
        exact = seen[0] if sum(h != 0 for h in readout) == 1 and seen else None
        gain = {i: self.put(f"K{tag}_{i}", weight * c[i]) for i in self.names if i != exact}
        for i in self.names:
            if c[i] != 0 and step != 0:
                self.mean[i] = self.put(f"M{tag}_{i}", self.mean[i] + c[i] * step)
        more = self.put(f"GROWN{tag}", 1 + sp.Float(ROUNDING) * there)
        for (i, j), value in list(self.cov.items()):
            grown = more if i == j else ONE
            if exact in (i, j):
                other = j if i == exact else i
                self.cov[i, j] = self.put(f"P{tag}_{i}_{j}", keep * c[other] * grown)
            elif c[i] != 0 and c[j] != 0:
                self.cov[i, j] = self.put(f"P{tag}_{i}_{j}", value * grown - gain[i] * c[j])

    def results(self) -> dict[str, str]:
        """Row of the belief to the name that holds its new value, where it has one."""
        found = {name: text_of(value) for name, value in self.mean.items()}
        for i, j in self.cov:
            found[f"P_{i}_{j}"] = text_of(self.cov[i, j])
        return {row: value for row, value in found.items() if row != value}


def update(
    model: Model, moved: Moved, degree: int, iterations: int, trace: bool, missing: bool
) -> tuple[Assignments, dict[str, str]]:
    """Condition on all sensors' outputs ``Y_<sensor>``, and learn the noises: assignments and results by row.

    Args:
        model: whose belief.
        moved: the motion over the sample.
        degree: of the input's polynomial, or taps less one.
        iterations: variational iterations.
        trace: also leave what the free energy of every iteration needs, in rows ``TRACE_<sensor's number>_<what>``.
        missing: an output that is NaN moves nothing but the state.
    """
    g = Gaussian(model, moved)
    results: dict[str, str] = {}
    showing = [k for k in range(model.n_outputs) if g.shown_noise(g.expected(k, degree)[1]) != 0][:1]
    if not showing:  # no sensor tells of γ: the noise moves the states as it is believed to
        g.add_noise(g.put("Q_unseen", symbol("GAMMA_RATE") / symbol("GAMMA_SHAPE")))
    for k, sensor in enumerate(model.outputs):
        tag, y = str(k), symbol(f"Y_{sensor}")
        expected, readout = g.expected(k, degree)
        expected = g.put(f"Y{tag}", expected)
        c, s = g.covariance_with(readout, tag)
        shown = g.put(f"N{tag}", g.shown_noise(readout)) if k in showing else ZERO
        seen = g.put(f"Z{tag}", present(y)) if missing else ONE
        e = g.put(f"E{tag}", select(seen, y - expected, ZERO) if missing else y - expected)
        learned = _learn(g, tag, sensor, (s, e, shown, seen), iterations)
        last = learned[-1]
        if shown != 0:
            along = {i: sum((readout[b] * n for b, n in enumerate(row)), ZERO)
                     for i, row in zip(g.states, g.moved.noise, strict=True)}  # fmt: skip
            c |= {i: g.put(f"D{tag}_{i}", c[i] + last.strength * part) for i, part in along.items() if part != 0}
            g.add_noise(last.strength)
            results |= {"GAMMA_SHAPE": text_of(last.gamma_shape), "GAMMA_RATE": text_of(last.gamma_rate)}
        results |= {f"XI_SHAPE_{sensor}": text_of(last.xi_shape), f"XI_RATE_{sensor}": text_of(last.xi_rate)}
        keep = last.r * last.weight
        weight = g.put(f"W{tag}", seen * last.weight)
        keep = g.put(f"H{tag}", select(seen, keep, ONE) if missing else keep)
        g.condition(readout, c, weight, last.step, keep, tag, seen)
        if trace:
            left = {"mean": expected, "innovation": e, "variance": s, "shown": shown}
            for i, one in enumerate(learned):
                left |= {f"q_{i}": one.q, f"r_{i}": one.r}
            results |= {f"TRACE_{tag}_{what}": text_of(value) for what, value in left.items()}
    return g.lines, results | g.results()


class Learned(NamedTuple):
    """What an iteration assumes and finds, in symbols.

    Attributes:
        strength: E[w²] of unit process noise that it assumes, 1/E[γ].
        q, r: variances of both noises in the output that it assumes.
        weight, step: 1/S, and the innovation times it.
        gamma_shape, gamma_rate, xi_shape, xi_rate: the beliefs that it finds.
    """

    strength: sp.Expr
    q: sp.Expr
    r: sp.Expr
    weight: sp.Expr
    step: sp.Expr
    gamma_shape: sp.Expr
    gamma_rate: sp.Expr
    xi_shape: sp.Expr
    xi_rate: sp.Expr


def _learn(
    g: Gaussian, tag: str, sensor: str, scalars: tuple[sp.Expr, sp.Expr, sp.Expr, sp.Expr], iterations: int
) -> list[Learned]:
    """The iterations over both noises, from s, e, hᵀ N h and whether the output is there.

    Both moments are sums of positive terms, E[v²] = r (r e²/S² + 1 - r/S). That of the process noise is counted for
    unit strength, so that nothing is divided by hᵀ N h, which may be 0 where the noise depends on the state.
    """
    s, e, shown, seen = scalars
    g_rate, n_rate = symbol("GAMMA_RATE"), symbol(f"XI_RATE_{sensor}")
    g_shape, n_shape = symbol("GAMMA_SHAPE"), symbol(f"XI_SHAPE_{sensor}")
    count = g.put(f"U{tag}", HALF * seen)
    new_g_shape = g.put(f"F{tag}", g_shape + count) if shown != 0 else g_shape
    new_n_shape = g.put(f"X{tag}", n_shape + count)
    # Divisions are dear, and every iteration has the same shapes.
    per_g = g.put(f"V{tag}", 1 / new_g_shape) if shown != 0 else ZERO
    per_n = g.put(f"A{tag}", 1 / new_n_shape)
    strength = g.put(f"B{tag}_0", g_rate / g_shape) if shown != 0 else ZERO
    r = g.put(f"R{tag}_0", n_rate / n_shape)
    found = []
    for i in range(iterations):
        q = g.put(f"Q{tag}_{i}", shown * strength)
        weight = g.put(f"L{tag}_{i}", 1 / (s + q + r))
        step = g.put(f"J{tag}_{i}", e * weight)
        square = g.put(f"T{tag}_{i}", step**2)
        new_g_rate, new_n_rate = (
            g.put(f"{letter}{tag}_{i}", rate + count * variance * (v * square + (1 - v * weight))) if v != 0 else rate
            for letter, rate, variance, v in (("G", g_rate, strength, q), ("O", n_rate, r, r))
        )
        found.append(Learned(strength, q, r, weight, step, new_g_shape, new_g_rate, new_n_shape, new_n_rate))
        strength = g.put(f"B{tag}_{i + 1}", new_g_rate * per_g) if shown != 0 else ZERO
        r = g.put(f"R{tag}_{i + 1}", new_n_rate * per_n)
    return found


def expected_sample(model: Model, moved: Moved, degree: int) -> tuple[Assignments, dict[str, str]]:
    """One imagined sample: `update` with outputs as expected and noise variances ``Q`` and ``R_<sensor>`` given.

    Leaves what the first sensor is expected to show in ``SHOWN``, its predictive variance in ``SPREAD``, and in
    ``SURPRISE`` that of `Gaussian.surprise`, which is 0 for the first sample: the row ``BEGUN`` is 1 after it.
    """
    g = Gaussian(model, moved)
    results: dict[str, str] = {}
    g.add_noise(symbol("Q"))
    for k, sensor in enumerate(model.outputs):
        tag, r = str(k), symbol(f"R_{sensor}")
        expected, readout = g.expected(k, degree)
        c, s = g.covariance_with(readout, tag)
        weight = g.put(f"L{tag}", 1 / (s + r))
        if k == 0:
            surprise = g.put("MOVED", symbol("BEGUN") * g.surprise(readout, r))
            results |= {"SHOWN": text_of(g.put("Y0", expected)), "SPREAD": text_of(g.put("V0", s + r))}
            results |= {"SURPRISE": text_of(surprise), "BEGUN": "1.0"}
        g.condition(readout, c, weight, ZERO, g.put(f"H{tag}", r * weight), tag)
    found = g.results()
    return g.lines, results | {row: value for row, value in found.items() if row not in model.coefficients}
