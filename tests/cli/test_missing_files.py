"""A file that is not there is an error before the work, which names the option that named it."""

from __future__ import annotations

import pytest


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("study armpi --twin-data no.mat --out made", "--twin-data"),
        ("study armpi --calibration no.npz --test other.npz --out made", "--calibration"),
        ("study no/case.toml --out made", "CASE"),
        ("fit armpi --real no.mat --out made", "--real"),
        ("fit armpi --real no.mat --out m", "--real"),
        ("fit armpi --real no.mat --prior no --out m", "--prior"),
        ("data info no.mat", "FILES"),
        ("data convert no.mat made.npz", "IN"),
        ("twin simulate armpi --commands no.npz --out made.npz", "--commands"),
        ("diagnose fit real.npz --from no --out made", "--from"),
        ("report no", "STUDY"),
        ("monitor run", "--config"),
    ],
)
def test_a_missing_file_is_named_by_its_option(call, words, named, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = call(*words.split())
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {named}")
    assert ": expected " in err
    assert not any(tmp_path.iterdir())


def test_a_missing_mapping_is_named_in_plain_words(call, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("time,level\n0,1\n1,2\n")
    code, _, err = call("data", "info", "log.csv", "--mapping", "no.toml")
    assert code == 2
    assert "no.toml: expected a mapping.toml, got no file of that name; check the name" in err
