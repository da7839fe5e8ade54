"""The headline: what a sample is worth, on few systems."""

import json

import numpy as np
import pytest

from agents.evaluation.rollout import evaluate
from agents.studies import headline
from agents.studies.headline import Config, main

AMPLITUDE = "duffing_env/Amplitude-v0"


def test_a_sample_of_the_regime_is_worth_one_and_one_of_a_better_policy_more(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(headline, "COMPARISONS", {"equal peak": (AMPLITUDE, ("prbs",))})
    main(Config(systems=24, seed=0, json=tmp_path / "headline.json"))
    printed = capsys.readouterr().out
    written = json.loads((tmp_path / "headline.json").read_text())
    prbs, regime = (written["comparisons"]["equal peak"][name] for name in ("prbs", "silverbox-multisine"))
    assert 0.5 < regime["worth_recorded"]["median"] < 2
    assert 20 < prbs["worth_recorded"]["low"] < prbs["worth_recorded"]["median"] < prbs["worth_recorded"]["high"]
    # At the limit of 0.15 V instead of its own peak of some 0.12 V, the regime tells more.
    assert 1 < prbs["worth_recorded"]["median"] / prbs["worth_scaled"]["median"] < 6
    (evaluation,) = evaluate(["prbs"], AMPLITUDE, 24)
    samples = np.count_nonzero(~np.isnan(evaluation.inputs), axis=0)
    expected = np.median(evaluation.metrics["silverbox_equivalent"] / samples)
    assert prbs["worth_recorded"]["median"] == pytest.approx(expected, rel=1e-6)
    assert prbs["twin_rmse"]["median"] < 0.5 * regime["twin_rmse"]["median"]
    assert "one sample, in samples of the regime" in printed
    if "arrow_rmse" in prbs:
        assert written["twin_on_the_arrow"] == pytest.approx(prbs["arrow_rmse"]["median"], rel=0.05)
