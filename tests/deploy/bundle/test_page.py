"""What docs/export.md shows is true."""

from __future__ import annotations

from pathlib import Path

import pytest
from test_readme import python_of

import retwin as rt
from retwin.deploy.bundle.bundle import Bundle


@pytest.mark.slow
def test_the_code_of_the_page_runs(
    bundle: Bundle,
    exported: tuple[Path, dict[str, float]],
    emulated: rt.Trajectories,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    bundle.twin.save("model")
    bundle.diagnoser.save("cnn")
    rt.save(emulated, "real.npz")
    (tmp_path / "portable").symlink_to(exported[0])
    names: dict = {}
    for code in python_of("export", "Bundles"):
        exec(compile(code, "docs/export.md", "exec"), names)
    assert (names["found"].verdicts.verdict == "ok").mean() > 0.9
    assert len(names["made"]) == 18
    assert len(names["again"]) == 2
