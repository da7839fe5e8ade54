"""Records of users: arrays, CSV and MAT files; cut samples, and refused records."""

import re
from pathlib import Path

import numpy as np
import pytest
from oscillators import BENCH, SOFT, rig_of, simulated
from tables import table

from estimator import Channel, Rig, identify
from estimator.identification.data import record_reader
from estimator.identification.data.column_choice import choose_columns
from estimator.identification.data.record_cleaning import find_clipped_outputs
from estimator.identification.data.record_reader import read_records


def read(path, rig):
    """Inputs and outputs of a file with one record."""
    (one,) = record_reader.read_record_file(path, rig)
    return one.u, one.y


def test_converter_levels_are_no_clipping():
    _, y = simulated(BENCH)
    level = np.abs(y).max() / 100
    assert not find_clipped_outputs(level * np.round(y / level)).any()
    assert not find_clipped_outputs(np.concatenate([np.full(100, y.min()), y])).any()


def test_clipping_of_single_samples_is_found():
    rng = np.random.default_rng(0)
    y = np.sin(2.2 * np.arange(500)) + 0.01 * rng.standard_normal(500)
    assert np.array_equal(find_clipped_outputs(np.minimum(y, 0.98)), y >= 0.98)
    assert np.diff(np.flatnonzero(y >= 0.98)).min() > 1
    assert not find_clipped_outputs(y).any()


def test_a_short_piece_between_missing_inputs_is_left_out():
    u, y = simulated(SOFT, samples=400)
    u[[200, 205]] = np.nan
    assert [(one.name, len(one.u)) for one in read_records((u, y), Rig(0.01))] == [
        ("record 0", 200),
        ("record 0, from sample 206", 194),
    ]


@table(
    ("heading", "input_name", "output_name", "reason"),
    [
        ("Zeit;Geschwindigkeit [mm/s];Spannung [V]", "Spannung [V]", "Geschwindigkeit [mm/s]", "unit"),
        ("t;accel [g];shaker force [N]", "shaker force [N]", "accel [g]", "name"),
        ("t;Beschleunigung [g];Kraft [N]", "Kraft [N]", "Beschleunigung [g]", "name"),
        ("Weg [µm];Kraft [mN]", "Kraft [mN]", "Weg [µm]", "name"),
        ("Temps;Déplacement;Entrée", "Entrée", "Déplacement", "name"),
        ("Tiempo;aceleración;fuerza", "fuerza", "aceleración", "name"),
        ("tempo;spostamento;forza", "forza", "spostamento", "name"),
        ("tijd;snelheid;kracht", "kracht", "snelheid", "name"),
        ("Ausgangsspannung [V];Anregungskraft", "Anregungskraft", "Ausgangsspannung [V]", "name"),
        ("t;CH1 [mm];CH2 [V]", "CH2 [V]", "CH1 [mm]", "unit"),
        ("t;CH1 [V];CH2 [N]", "CH2 [N]", "CH1 [V]", "unit"),
        ("t;CH1 [V];CH2 [°C];CH3 [m/s²]", "CH1 [V]", "CH3 [m/s²]", "unit"),
        ("t;x force [N];x disp [m]", "x force [N]", "x disp [m]", "unit"),
        ("t;input base acc [m/s2];acc mass [m/s2]", "input base acc [m/s2]", "acc mass [m/s2]", "name"),
        ("t;Channel A (V);Channel B (mV)", "Channel A (V)", "Channel B (mV)", "order"),
        ("t;CH1;CH2", "CH1", "CH2", "order"),
        ("X_Value;Force;Laser", "Force", "Laser", "name"),
        ("sample;time;u;y;commanded;late_output", "u", "y", "name"),
        ("t;CH1 [mm]", None, "CH1 [mm]", "unit"),
    ],
)
def test_columns_are_chosen_by_names_then_units_then_order(heading, input_name, output_name, reason):
    names = heading.split(";")
    choice = choose_columns(Path("r.csv"), names, len(names), None, None)
    assert (None if choice.input is None else names[choice.input]) == input_name
    assert (names[choice.output], choice.reason) == (output_name, reason)


@table(
    ("heading", "first", "second"),
    [
        ("t;displacement [N];force [m]", "'force [m]' is the input", "'displacement [N]' the output"),
        ("t;x [N];CH2 [mm]", "'CH2 [mm]' is the input", "'x [N]' the output"),
        ("t;CH1 [N];CH2 [mN]", "'CH1 [N]' and 'CH2 [mN]'", "are both an input"),
        ("t;CH1 [mm];CH2 [m/s]", "'CH1 [mm]' and 'CH2 [m/s]'", "are both an output"),
    ],
)
def test_columns_whose_names_and_units_contradict_are_refused(heading, first, second):
    names = heading.split(";")
    with pytest.raises(ValueError, match="--input and --output of duffing-env rig init") as error:
        choose_columns(Path("r.csv"), names, len(names), None, None)
    assert first in str(error.value)
    assert second in str(error.value)
    choose_columns(Path("r.csv"), names, len(names), names[1], names[2])


def test_a_column_that_is_named_in_part_is_proposed():
    with pytest.raises(ValueError, match=r"--input or the rig's \[input\] names.*; write 'shaker force'"):
        choose_columns(Path("r.csv"), ["t", "shaker force [N]", "accel [g]"], 3, "force", None)


def test_an_input_in_place_of_the_output_is_questioned(tmp_path):
    rng = np.random.default_rng(0)
    held, moving = np.repeat(rng.uniform(-1, 1, 32), 24), np.sin(np.arange(768) / 9) + rng.standard_normal(768)
    rows = "\n".join(f"{a},{b}" for a, b in zip(held, moving, strict=True))
    (tmp_path / "r.csv").write_text(f"laser,shaker\n{rows}")
    rig = Rig(0.01, input=Channel(column="shaker"), output=Channel(column="laser"))
    with pytest.raises(ValueError, match="must have at least 50 outputs in all, but have") as error:
        read_records(tmp_path / "r.csv", rig)
    assert re.search(r"of 768 outputs \d+ (are clipped|repeat)[\w ,]* and count as missing", str(error.value))
    assert "name the columns if these are wrong: Input: shaker; output: laser, a displacement" in str(error.value)


def test_files(tmp_path):
    u, y = simulated(SOFT, samples=400)
    lines = [f"{k * 0.01:.6f},{a},{b}" for k, (a, b) in enumerate(zip(u, y, strict=True))]
    plain, named = tmp_path / "plain.csv", tmp_path / "named.csv"
    plain.write_text("\n".join(lines))
    lines[7] = lines[7].rsplit(",", 1)[0] + ","
    named.write_text("# a comment\nTime [s],Force [N],Displacement [m]\n" + "\n".join(lines) + "\n")
    (one,), (other,) = (read_records(path, Rig(0.01)) for path in (plain, str(named)))
    np.testing.assert_array_equal(one.u, u)
    assert (one.n_missing, other.n_missing) == (0, 1)
    from scipy.io import savemat

    savemat(tmp_path / "r.mat", {"u": u, "y": y})
    np.testing.assert_array_equal(read_records(tmp_path / "r.mat", Rig(0.01))[0].y, y)
    whole = bytearray((tmp_path / "r.mat").read_bytes())
    whole[176] ^= 1  # an unknown kind of number, of which SciPy's reader dies
    (tmp_path / "r.mat").write_bytes(whole)
    with pytest.raises(ValueError, match=r"r\.mat must be a sound MAT file, but is not: the reader crashed"):
        read_records(tmp_path / "r.mat", Rig(0.01))
    (tmp_path / "r.mat").write_bytes(b"none")
    with pytest.raises(ValueError, match=r"r\.mat must be a sound MAT file"):
        read_records(tmp_path / "r.mat", Rig(0.01))


@table(
    "text",
    [
        "u;y\n0,5;1\n1,5;-2e-1\n;3\n",
        "\ufeffu\ty\n0.5\t1\n\n1.5\t-0.2\n\t3\n",
        "# written by a tool, with; signs\n0.5 1\n  1.5   -0.2 \nnan 3\n",
        "response [mm], time [ms], force [N]\n1, 10, 0.5\n-0.2, 20, 1.5\n3, 30, \n",
        "time,force,displacement\ns,N,mm\n0,0.5,1\n0.01,1.5,-0.2\n0.02,n/a,3\n",
        "time,force [N],displacement\n[ms],(N),[mm]\n0,0.5,1\n10,1.5,-0.2\n20,n/a,3\n",
        "time,force,displacement [mm]\ns,none,[-]\n0,0.5,1\n0.01,1.5,-0.2\n0.02,n/a,3\n",
        "u y\n0.5 1\n1.5 -0.2\nNA 3\n",
        ",,,\nu,y\n,\n0.5,1\n1.5,-0.2\nnull,3\n",
    ],
)
def test_tables_as_programs_write_them(tmp_path, text):
    (tmp_path / "r.csv").write_text(text, encoding="utf-8")
    u, y = read(tmp_path / "r.csv", Rig(0.01))
    np.testing.assert_array_equal(u, [0.5, 1.5, np.nan])
    np.testing.assert_array_equal(y, [1.0, -0.2, 3.0])


def test_columns_of_any_name_are_named_in_the_rig(tmp_path):
    rig = Rig(0.01, input=Channel("N", column="Kraft"), output=Channel("mm", column="Weg [mm]"))
    (tmp_path / "r.csv").write_text("Zeit [s];Weg [mm];kraft [N];x\n0;1;5;7\n0,01;2;6;8\n")
    np.testing.assert_array_equal(read(tmp_path / "r.csv", rig), [[5, 6], [1, 2]])
    assert Rig.from_dict(rig.to_dict()) == rig
    for text, message in (
        ("u,y\n5,1\n", r"one column 'Kraft', which --input or the rig's \[input\] names, but has \['u', 'y'\]"),
        ("Kraft,Weg [mm],Weg [mm]\n5,1,2\n", r"one column 'Weg \[mm\]', which --output or the rig's \[output\] names"),
        ("5,1\n6,2\n", "must name its columns, because the rig names them"),
    ):
        (tmp_path / "other.csv").write_text(text)
        with pytest.raises(ValueError, match=message):
            read(tmp_path / "other.csv", rig)
    with pytest.raises(ValueError, match="the rig names 'Kraft' for input and output"):
        read(tmp_path / "r.csv", Rig(0.01, input=rig.input, output=Channel("N", column="Kraft")))
    from scipy.io import savemat

    savemat(tmp_path / "r.mat", {"Kraft": [5.0, 6.0], "y": [1.0, 2.0], "Weg": [0.0, 0.0]})
    of_mat = Rig(0.01, input=rig.input, output=Channel("mm"))
    np.testing.assert_array_equal(read(tmp_path / "r.mat", of_mat), [[5, 6], [1, 2]])
    with pytest.raises(ValueError, match=r"r\.mat must hold the variables Kraft and Weg \[mm\], but lacks Weg \[mm\]"):
        read(tmp_path / "r.mat", rig)
    with pytest.raises(ValueError, match="column must be a name"):
        Channel(column=3)


@table(("separator", "mark"), [(",", "."), (";", ","), ("\t", "."), (" ", ".")])
def test_regular_lines_are_read_as_others_are(tmp_path, separator, mark):
    values = np.random.default_rng(0).standard_normal((50, 2)) * 10.0 ** np.arange(-25, 25)[:, None]
    lines = [separator.join(map(repr, map(float, row))).replace(".", mark) for row in values]
    (tmp_path / "regular.csv").write_text("\n".join([separator.join("uy"), *lines]))
    (tmp_path / "missing.csv").write_text("\n".join([separator.join("uy"), *lines, f"1{separator}nan"]))
    regular, missing = (read(tmp_path / f"{name}.csv", Rig(0.01)) for name in ("regular", "missing"))
    np.testing.assert_array_equal(np.transpose(regular), values)
    np.testing.assert_array_equal(np.transpose(missing)[:-1], values)


def test_times_are_even_between_missing_inputs_only(tmp_path):
    (tmp_path / "r.csv").write_text("t,u,y\n0,1,2\n0.01,1,3\n,,\n7,1,2\n7.01,2,3\n7.02,,3\n9,2,2\n9.01,2,2\n,,,,\n")
    u, _ = read(tmp_path / "r.csv", Rig(0.01))
    np.testing.assert_array_equal(u, [1, 1, np.nan, 1, 2, np.nan, 2, 2, np.nan])


@table(
    ("text", "message"),
    [
        ("u,y\n1,2\n3", "line 3: must have 2 columns, but has 1"),
        ("u,y\n1,2\n3,x4", "line 3: 'x4' must be a number; leave it empty"),
        ("u,y\n1,2\n1_0,2", "line 3: '1_0' must be a number"),
        ('u,y\n1,2\n"0,5",2', "line 3: '0,5' must be a number; beside decimal commas let semicolons or tabs separate"),
        ("t;u;y\n0,01;8.000;0,5\n", "line 2: '8.000' must have the decimal mark ',' alone"),
        ("u;y\n1,5;2\n1.234,5;2\n", "line 3: '1.234,5' must be a number; leave out marks"),
        ("u;y\n1,5;2\n;2\n1;2.5\n", "line 4: '2.5' must have the decimal mark ',' alone"),
        ("t,u [N],y\n[s],[kN],[m]\n0,1,2\n", "'u [N]' must have one unit, but 'kN' stands below"),
        ("c_column,b_column,d_column\n1,2,3", "must have one column of inputs and one of outputs"),
        ("1,2,3,4\n1,2,3,4", "must have two columns, u and y"),
        (
            "t,u,y\n" + "".join(f"{k / 2},{k % 3},{k}\n" for k in range(60)),
            "times are 0.5 s apart, but the step is 0.01 s",
        ),
        ("t,u,y\n0,1,2\n0.01,1,3\n0.01,2,3\n", "line 4: times must increase, but 0.01 s comes after 0.01 s"),
        ("t,u,y\n0,1,2\n,1,3\n0.02,2,3\n", "line 3: the input must have a time, but has none"),
        ("t,u,y\n0,,2\n0.01,,3\n", "must have two samples in a row with time and input, but has none"),
        ("t [days],u,y\n0,1,2\n1,1,3\n", "the unit of the times must be one of s, ms, us,"),
        ("", "must hold numbers, but holds none"),
    ],
)
def test_errors_of_files_name_the_line(tmp_path, text, message):
    (tmp_path / "r.csv").write_text(text)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        read_records(tmp_path / "r.csv", Rig(0.01))
    assert "r.csv" in str(error.value)


@table(
    ("records", "message"),
    [
        ([], "records must hold at least one pair"),
        (3, "records must be a list of pairs"),
        ({"u": [1.0], "y": [2.0]}, "records must be a list of pairs"),
        ([3], "record 0 must be a pair (u, y) or a file name, but is 3; pass (u, y) as one tuple"),
        ([(np.ones(100), np.ones(99))], "u and y of record 0 must have one length, but have 100 and 99"),
        ([(np.ones(20), np.arange(20.0))], "must have at least 50 outputs in all, but have 20"),
        (
            [(np.ones(4000), np.full(4000, np.nan))],
            "record 0 must have 8 outputs or more between missing inputs, but of "
            "its 4000 samples 0 have both input and output",
        ),
        ([simulated(SOFT, samples=400), (np.ones(5), np.arange(5.0))], "record 1 must have 8 outputs or more"),
        ([simulated(SOFT, samples=400)] * 2, "record 1 must be a record of its own, but has the samples of record 0"),
        (
            [given := simulated(SOFT, samples=400), (given[0], np.where(np.arange(400) % 9, given[1], np.nan))],
            "record 1 must be a record of its own, but has the samples of record 0",
        ),
        ([(np.arange(100.0), np.ones(100))], "y must vary, but is constant"),
        ([(np.full(100, np.inf), np.arange(100.0))], "u of record 0 must be finite"),
    ],
)
def test_errors_name_the_record(records, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        identify(rig_of(BENCH), records)


@table(
    ("names", "message"),
    [
        ("u [kV],y [mm/s]", "'u [kV]' must be in the rig's unit, N, but is in kV; convert the column"),
        ("force [N],velocity [counts]", "'velocity [counts]' must be in the rig's unit, mm/s, but is in counts"),
        ("force [N],displacement [mm/s]", "must be the rig's kind of output, velocity, but is called displacement"),
        ("CH1 [V],CH2 [A],v [mm/s]", "rename the input to u, input or force"),
    ],
)
def test_names_of_columns_that_contradict_the_rig_are_refused(tmp_path, names, message):
    count = names.count(",") + 1
    (tmp_path / "r.csv").write_text("\n".join([names, *(",".join(f"{k + j}" for j in range(count)) for k in range(4))]))
    rig = Rig(0.01, input=Channel("N"), output=Channel("mm/s", kind="velocity"))
    with pytest.raises(ValueError, match=re.escape(message)):
        read(tmp_path / "r.csv", rig)


@table(
    ("names", "factors"),
    [("u [kN],y [mm/s]", (1e3, 1.0)), ("force_mN,v_m/s", (1e-3, 1e3)), ("force [lbf],v [in/s]", (4.4482216, 25.4))],
)
def test_a_column_in_another_unit_of_the_same_quantity_is_converted(tmp_path, names, factors):
    (tmp_path / "r.csv").write_text("\n".join([names, "1,2", "3,∞", ",4"]), encoding="utf-8")
    u, y = read(tmp_path / "r.csv", Rig(0.01, input=Channel("N"), output=Channel("mm/s", kind="velocity")))
    np.testing.assert_allclose(u, factors[0] * np.array([1, 3, np.nan]), rtol=1e-7)
    np.testing.assert_allclose(y, factors[1] * np.array([2, np.nan, 4]), rtol=1e-7)


def test_units_in_another_way_of_writing_and_times_of_another_name_are_taken(tmp_path):
    rig = Rig(0.002, input=Channel("µN"), output=Channel("m/s²", kind="acceleration"))
    (tmp_path / "r.csv").write_text("Zeit [ms];u [μN];a [m/s^2]\n0;1;2\n2;3;4\n")
    np.testing.assert_array_equal(read(tmp_path / "r.csv", rig), [[1, 3], [2, 4]])


def test_a_mat_file_is_read_by_nothing_that_lies_beside_it_and_not_for_ever(tmp_path, monkeypatch):
    from scipy.io import savemat

    u, y = simulated(SOFT, samples=400)
    savemat(tmp_path / "r.mat", {"u": u, "y": y})
    monkeypatch.chdir(tmp_path)
    for name in ("numpy", "io", "scipy"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('a file of the user was executed')")
    np.testing.assert_array_equal(read("r.mat", Rig(0.01))[1], y)
    monkeypatch.setattr(
        "estimator.identification.data.mat_files._MAT_TIMEOUT", 0.0
    )  # which no machine is quick enough for
    with pytest.raises(ValueError, match=r"r\.mat must be a MAT file that can be read within 0 s, but was not"):
        read("r.mat", Rig(0.01))


def copies(u, y):
    """Records that a user may combine by mistake, and the sample from which the second repeats the first."""
    again = np.concatenate([u, [np.nan], u]), np.concatenate([y, [np.nan], y])
    late = y.copy()
    late[[40, 150]] = np.nan
    return {
        "without the last": ([(u, y), (u[:-1], y[:-1])], "record 1", 0, "record 0", 0),
        "without the first": ([(u, y), (u[1:], y[1:])], "record 1", 0, "record 0", 1),
        "longer": ([(u[:200], y[:200]), (u, y)], "record 1", 0, "record 0", 0),
        "the end only": ([(u[300:], y[300:]), (u, y)], "record 1", 300, "record 0", 0),
        "overlap": ([(u[:250], y[:250]), (u[190:], y[190:])], "record 1", 0, "record 0", 190),
        "one record": (again, "record 0, from sample 401", 0, "record 0", 0),
        "missing": ([(u, y), (u[1:], late[1:])], "record 1", 40, "record 0", 41),
        "three": ([(u, y), simulated(BENCH, samples=400), (u[2:], y[2:])], "record 2", 0, "record 0", 2),
    }


@table("how", copies(np.zeros(400), np.zeros(400)))
def test_samples_that_come_twice_are_refused(how):
    given, later, at, earlier, begin = copies(*simulated(SOFT, samples=400))[how]
    message = (
        f"{later} must have samples of its own, but its samples from {at} on are samples of {earlier} "
        f"from sample {begin}"
    )
    with pytest.raises(ValueError, match=re.escape(message)):
        read_records(given, Rig(0.01))


def test_experiments_that_were_repeated_are_two_records():
    """The same inputs, periodic ones without noise, and rests between two levels of a converter, are no copies."""
    rng = np.random.default_rng(0)
    u, y = simulated(SOFT, samples=1_000)
    assert len(read_records([(u, y), (u, y + 1e-3 * rng.standard_normal(1_000))], Rig(0.01))) == 2
    half = np.repeat([0.5, -0.5], 500)
    assert len(read_records([(half, y), (half, y[::-1].copy())], Rig(0.01))) == 2
    period = np.tile(np.sin(np.arange(100) * 2 * np.pi / 100), 6)
    gap = np.concatenate([period, [np.nan], period])
    assert len(read_records((gap, np.roll(period, 9)[np.arange(len(gap)) % 600]), Rig(0.01))) == 2
    rest = np.zeros(300)
    one, other = (
        (np.concatenate([rest, u]), np.concatenate([rest, noisy]))
        for noisy in (y, y + 1e-3 * rng.standard_normal(1_000))
    )
    assert len(read_records([one, other], Rig(0.01))) == 2
    # A converter whose levels are ten times the noise: most outputs repeat the first record's.
    level = np.ptp(y) / 100
    coarse = [level * np.round((y + 0.1 * level * rng.standard_normal(1_000)) / level) for _ in range(2)]
    assert 0.85 < (coarse[0] == coarse[1]).mean() < 1
    assert len(read_records([(u, one) for one in coarse], Rig(0.01))) == 2


def test_a_million_samples_are_compared_at_once():
    from estimator.identification.data.duplicate_samples import find_shared_samples

    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((2, 1_000_000))
    assert find_shared_samples([(u, y), (u, y[::-1])]) is None
    assert find_shared_samples([(u[:600_000], y[:600_000]), (u[599_900:], y[599_900:])]) == (0, 599_900, 1, 0)


def test_an_absurd_number_is_refused_by_record_and_sample(tmp_path):
    u, y = simulated(SOFT, samples=400)
    y[7] = 1e300
    with pytest.raises(ValueError, match=r"y of record 0 must be within ±1e\+30, but at sample 7 is 1e\+300; leave it"):
        read_records((u, y), rig_of(SOFT))
    path = tmp_path / "absurd.csv"
    path.write_text("u,y\n" + "".join(f"{a!r},{b!r}\n" for a, b in zip((-u).tolist(), u.tolist(), strict=True)))
    path.write_text(path.read_text().replace(repr(-float(u[3])), "-1e299", 1))
    with pytest.raises(ValueError, match=rf"u of {re.escape(str(path))} must be within ±1e\+30, but at sample \d+ is "):
        read_records(path, rig_of(SOFT))


def written(u, y, kind, step=0.01):
    """A record as an instrument writes it, and the rig whose step it has."""
    rows = list(zip((step * np.arange(len(u))).tolist(), u.tolist(), y.tolist(), strict=True))
    match kind:
        case "scope":
            head = "Model,SCOPE\nHorizontal Units,s\nSample Interval,0.01\n\nTIME,CH1,CH2\n"
            return head + "".join(f"{t:.6f},{a!r},{b!r}\n" for t, a, b in rows)
        case "lvm":
            head = "LabVIEW Measurement\t\nSeparator\tTab\n***End_of_Header***\t\nChannels\t2\t\n"
            head += "***End_of_Header***\t\nX_Value\tForce\tLaser\tComment\n"
            return head + "".join(f"{t:.6f}\t{a!r}\t{b!r}\n" for t, a, b in rows)
        case "excel":
            body = "".join(f"{t:.6f};{a!r};{b!r}\n" for t, a, b in rows)
            return "sep=;\ntime [s];force [N];displacement [m]\n" + body.replace(".", ",")
        case "iso":
            body = "".join(f"2026-05-01T23:59:{58 + t:09.6f},{a!r},{b!r}\n" for t, a, b in rows[:200])
            return "timestamp,force [N],displacement [m]\n" + body
        case "units below":
            body = "".join(f"{1e3 * t:.6f},{a!r},{1e3 * b!r}\n" for t, a, b in rows)
            return "Time,Channel A,Channel B\n(ms),(V),(mV)\n\n" + body
        case _:
            factor = {"ms": 1e3, "us": 1e6}[kind.rpartition("|")[2]]
            body = "".join(f"{factor * t:.4f},{a!r},{b!r}\n" for t, a, b in rows)
            return f"{kind.partition('|')[0]},u,y\n" + body


@table(
    ("kind", "encoding"),
    [
        ("scope", "utf-8"), ("lvm", "cp1252"), ("excel", "utf-16"), ("iso", "utf-8"), ("units below", "utf-8"),
        ("time_ms|ms", "utf-8"), ("Time/ms|ms", "utf-8"), ("t / ms|ms", "utf-8"), ("time ms|ms", "utf-8"),
        ("Time {ms}|ms", "utf-8"), ("Time in ms|ms", "utf-8"), ("time_us|us", "utf-8"), ("Zeit [µs]|us", "cp1252"),
    ],
)  # fmt: skip
def test_files_of_instruments_are_read_in_their_units(tmp_path, kind, encoding):
    u, y = simulated(SOFT, samples=400)
    (tmp_path / "r.csv").write_bytes(written(u, y, kind).encode(encoding))
    (one,) = read_records(tmp_path / "r.csv", Rig(0.01))
    assert one.times is None, "they are a step apart"
    np.testing.assert_allclose(one.u, u[: len(one.u)], rtol=1e-14)
    scale = 1e3 if kind == "units below" else 1.0
    np.testing.assert_allclose(one.y, scale * y[: len(one.y)], rtol=1e-14)


def test_a_record_of_another_rate_is_identified_with_the_rest():
    truth, step, *_ = SOFT
    u, y = simulated(SOFT, samples=4096)
    late = u[2048::2], y[2048::2], 2 * step * np.arange(1024)  # each input is held for four samples
    result = identify(rig_of(SOFT), [(u[:2048], y[:2048]), late])
    np.testing.assert_allclose(np.diff(result.records[1].times), 2 * step)
    assert np.abs([(result.parameters[p][0] - truth[p]) / result.parameters[p][1] for p in truth]).max() < 4


def test_lost_lines_and_values_over_range_are_missing(tmp_path):
    u, y = simulated(SOFT, samples=400)
    lines = [f"{0.01 * k:.2f},{a!r},{b!r}" for k, (a, b) in enumerate(zip(u.tolist(), y.tolist(), strict=True))]
    lines[50] = "0.50,1.0,∞"
    del lines[200:203]
    (tmp_path / "r.csv").write_text("\n".join(["time [s],force [N],displacement [m]", *lines]), encoding="utf-8")
    first, second = read_records(tmp_path / "r.csv", Rig(0.01))
    assert (first.n_clipped, first.n_missing, len(first.u), len(second.u)) == (1, 0, 200, 197)
