"""Films of trajectories: really written and read back; and the pose behind a measured tip."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner

import retwin as rt
from retwin.cases.animation import animate
from retwin.cases.animation.shots import Shots
from retwin.cases.animation.solid import mujoco_pictures
from retwin.cases.armpi_fpv.body import ArmBody
from retwin.cli.twins import app
from retwin.data.io import save
from retwin.errors import InputError

SIZE = (320, 240)
FPS = 10
FRAMES = 15
TWO_LINKS = """<mujoco><worldbody>
<body name="upper"><joint name="shoulder" axis="1 0 0"/><geom type="capsule" size="0.02"
  fromto="0 0 0 0 0 0.2" rgba="0.8 0.2 0.1 1"/>
<body name="lower" pos="0 0 0.2"><joint name="elbow" axis="1 0 0"/><geom type="capsule" size="0.02"
  fromto="0 0 0 0 0 0.2" rgba="0.8 0.2 0.1 1"/></body></body></worldbody></mujoco>"""


@dataclass(frozen=True)
class TwoLinks:
    """Two links that follow the first two commands of any trajectory."""

    model: Path | None
    joints: tuple[str, ...] = ("shoulder", "elbow")

    def poses(self, trajectories: rt.Trajectories) -> tuple[NDArray, NDArray]:
        nominal = (trajectories.commands[..., :2] - 500.0) / 200.0
        return nominal, nominal + 0.3

    def skeleton(self, joints: NDArray) -> NDArray:
        angle = np.cumsum(joints, axis=-1)
        links = 0.2 * np.stack([0 * angle, -np.sin(angle), np.cos(angle)], axis=-1)
        return np.cumsum(np.concatenate([0 * links[..., :1, :], links], axis=-2), axis=-2)


@pytest.fixture(scope="module")
def short(case: rt.Case) -> rt.Trajectories:
    """Two trajectories of 1.5 s, biased, as if they were emulated."""
    commands = case.sampler.sample(2, rng=np.random.default_rng(3))[:, :150]
    biased = "Motor_2_Steady_state_error"
    made = case.twin.simulate(commands, faults=[case.faults[biased]] * 2, seed=4)
    return made.replace(emulated=True, ids=["first", "second"], labels=[biased] * 2)


@pytest.fixture
def two_links(case: rt.Case, tmp_path: Path) -> rt.Case:
    model = tmp_path / "two_links.xml"
    model.write_text(TWO_LINKS, encoding="utf-8")
    return replace(case, body=TwoLinks(model))


def pictures(path: Path) -> list[NDArray]:
    with Image.open(path) as film:
        found = []
        for i in range(film.n_frames):
            film.seek(i)
            found.append(np.asarray(film.convert("RGB")))
        return found


def test_stick_figure(short: rt.Trajectories, case: rt.Case, tmp_path: Path) -> None:
    reported: list[float] = []
    film = tmp_path / "arm.gif"
    made = animate(
        short, case, film, fps=FPS, size=SIZE, renderer="stick", progress=reported.append
    )
    assert made == film
    found = pictures(film)
    assert len(found) == FRAMES == len(reported)
    assert reported[-1] == 1.0
    assert all(each.shape == (SIZE[1], SIZE[0], 3) for each in found)
    middle = slice(60, 180)  # neither title nor legend
    moved = [(a[middle] != b[middle]).any() for a, b in pairwise(found)]
    assert np.mean(moved) > 0.5
    with Image.open(film) as again:
        shown = []
        for i in range(again.n_frames):
            again.seek(i)
            shown.append(again.info["duration"])
    assert sum(shown) == 1000 * FRAMES / FPS


@pytest.mark.slow
def test_same_trajectory_gives_same_bytes(
    short: rt.Trajectories, case: rt.Case, tmp_path: Path
) -> None:
    def film(name: str, index: int | str) -> bytes:
        made = animate(
            short, case, tmp_path / name, index=index, fps=2, size=SIZE, renderer="stick"
        )
        return made.read_bytes()

    assert film("a.gif", 1) == film("b.gif", "second")
    assert film("c.gif", 0) != film("d.gif", 1)


@dataclass(frozen=True)
class Offset:
    """An updated twin: each simulation is off by a constant of its own, of some mm."""

    plain: rt.Twin
    rate: float = 100.0

    @property
    def inputs(self) -> rt.Channels:
        return self.plain.inputs

    @property
    def outputs(self) -> rt.Channels:
        return self.plain.outputs

    def simulate(self, commands: NDArray, *, seed: int, **_: object) -> rt.Trajectories:
        drawn = 0.01 * np.random.default_rng(seed).standard_normal((len(commands), 1, 3))
        nominal = np.full((*commands.shape[:2], 3), (0.1, 0.1, 0.2))
        return rt.Trajectories(commands, nominal, nominal + drawn, self.rate)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(320, 240), (480, 240)])
def test_an_updated_twin_is_in_the_film(
    short: rt.Trajectories, case: rt.Case, tmp_path: Path, size: tuple[int, int]
) -> None:
    """Its draws around the tip, and its band in a chart that time uncovers."""

    def film(name: str, **more: object) -> list[NDArray]:
        path = tmp_path / name
        animate(short, case, path, fps=2, size=size, renderer="stick", **more)  # type: ignore[arg-type]
        return pictures(path)

    plain, shown = film("a.gif"), film("b.gif", updated=Offset(case.twin))
    assert all(each.shape == (size[1], size[0], 3) for each in shown)

    def green(picture: NDArray) -> int:
        red, also, blue = (picture[..., i].astype(int) for i in range(3))
        return int(((also > red + 40) & (also > blue + 15)).sum())

    assert green(plain[-1]) == 0
    assert green(shown[0]) > 20
    assert green(shown[-1]) > 2 * green(shown[0]), "the veil is gone at the end"
    assert (film("c.gif", updated=Offset(case.twin), seed=1)[-1] != shown[-1]).any()
    with pytest.raises(InputError, match=r"updated\.rate: expected that of the trajectory, 100"):
        film("d.gif", updated=Offset(case.twin, rate=50.0))
    with pytest.raises(InputError, match="from 320x240 to"):
        animate(short, case, tmp_path / "d.gif", size=(160, 160), updated=Offset(case.twin))
    assert not (tmp_path / "d.gif").exists()


def test_mp4(short: rt.Trajectories, case: rt.Case, tmp_path: Path) -> None:
    from imageio_ffmpeg import count_frames_and_secs, read_frames

    film = animate(short, case, tmp_path / "arm.mp4", fps=FPS, size=SIZE, renderer="stick")
    frames, seconds = count_frames_and_secs(str(film))
    assert frames == FRAMES
    assert seconds == pytest.approx(FRAMES / FPS, abs=0.05)
    reader = read_frames(str(film))
    assert next(reader)["size"] == SIZE
    reader.close()


@pytest.mark.slow
def test_mujoco_draws_or_says_what_is_missing(
    short: rt.Trajectories, case: rt.Case, tmp_path: Path
) -> None:
    before = dict(os.environ)
    film = tmp_path / "arm.gif"
    sticks = animate(short, case, tmp_path / "s.gif", fps=2, size=SIZE, renderer="stick")
    try:
        animate(short, case, film, fps=2, size=SIZE, renderer="mujoco")
    except InputError as error:
        assert "libegl1" in str(error)
        assert not film.exists()
        with pytest.warns(UserWarning, match="stick figure: renderer"):
            animate(short, case, film, fps=2, size=SIZE)
        assert film.read_bytes() == sticks.read_bytes()
    else:
        solid, thin = pictures(film), pictures(sticks)
        assert len(solid) == len(thin)
        assert all((a != b).any() for a, b in zip(solid, thin, strict=True))
    assert dict(os.environ) == before


def test_without_opengl_there_are_sticks_and_a_warning(
    short: rt.Trajectories, case: rt.Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "no such thing")
    with pytest.raises(InputError, match=r"libegl1.*libosmesa6") as caught:
        animate(short, case, tmp_path / "a.gif", fps=2, size=SIZE, renderer="mujoco")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
    with pytest.warns(UserWarning, match=r"drawn as a stick figure: .*libegl1"):
        animate(short, case, tmp_path / "b.gif", fps=2, size=SIZE)
    assert len(pictures(tmp_path / "b.gif")) == 3


@pytest.mark.parametrize(
    ("package", "suffix", "renderer"),
    [("OpenGL", "gif", "mujoco"), ("imageio_ffmpeg", "mp4", "stick")],
)
def test_missing_extra(
    short: rt.Trajectories,
    case: rt.Case,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    package: str,
    suffix: str,
    renderer: str,
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=r'pip install .*\[render\]"'):
        animate(short, case, tmp_path / f"a.{suffix}", renderer=renderer)
    assert not list(tmp_path.iterdir())


def test_ghost_and_solid_differ(two_links: rt.Case, tmp_path: Path) -> None:
    still = np.zeros((1, 2))

    def shots(bend: float) -> Shots:
        poses = np.stack([still, still + bend])
        return Shots("", False, np.zeros(1), poses, two_links.body.skeleton(poses))

    def drawn(bend: float) -> NDArray:
        with mujoco_pictures(shots(bend), two_links.body, SIZE) as found:
            return np.stack(list(found))[0].astype(int)

    try:
        together, separate = drawn(0.0), drawn(0.6)
    except InputError as error:
        assert "libegl1" in str(error)
        return

    def red(picture: NDArray) -> NDArray:
        return picture[..., 0] > picture[..., 2] + 40

    def grey(picture: NDArray) -> NDArray:
        return (picture.max(axis=2) - picture.min(axis=2) < 40) & (picture.mean(axis=2) < 215)

    assert red(together).sum() > 300
    assert red(separate).sum() == pytest.approx(red(together).sum(), rel=0.3), "one solid body"
    assert grey(separate).sum() > grey(together).sum() + 200, "the ghost comes out from behind it"
    assert (grey(separate) & red(together)).sum() > 100, "where the nominal pose is"


def test_model_without_the_joints(
    two_links: rt.Case, short: rt.Trajectories, tmp_path: Path
) -> None:
    body = replace(two_links.body, joints=("shoulder", "wrist"))
    with pytest.raises(InputError, match=r"joints shoulder, wrist|libegl1"):
        animate(short, replace(two_links, body=body), tmp_path / "a.gif", renderer="mujoco")
    chain = replace(two_links, body=TwoLinks(None))
    with pytest.raises(InputError, match="stick figure"):
        animate(short, chain, tmp_path / "a.gif", renderer="mujoco")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"path": "arm.avi"}, r"\.mp4 or \.gif"),
        ({"index": 2}, "a position from 0 to 1, got 2"),
        ({"index": "third"}, "one of 2 ids .first, second., got 'third'"),
        ({"fps": 0}, "fps"),
        ({"size": (321, 240)}, "even width and height"),
        ({"renderer": "crayon"}, "one of auto, mujoco, stick"),
    ],
)
def test_bad_input_writes_nothing(
    short: rt.Trajectories, case: rt.Case, tmp_path: Path, changes: dict, message: str
) -> None:
    path = tmp_path / changes.pop("path", "arm.gif")
    with pytest.raises(InputError, match=message):
        animate(short, case, path, **changes)
    assert not list(tmp_path.iterdir())


def test_case_that_cannot_be_drawn(short: rt.Trajectories, case: rt.Case, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a case with a body"):
        animate(short, replace(case, body=None), tmp_path / "a.gif")
    other = short.replace(outputs=rt.Channels(("a", "b", "c"), ("m",) * 3))
    with pytest.raises(InputError, match="outputs"):
        animate(other, case, tmp_path / "a.gif")


@pytest.mark.slow
def test_command_line(short: rt.Trajectories, tmp_path: Path) -> None:
    save(short, tmp_path / "set.npz")
    words = ["simulate", "armpi-kinematic", "--film", str(tmp_path / "arm.gif")]
    settings = ["--renderer", "stick", "--fps", "2", "--size", "320x240"]
    made = [*words, *settings, "--n", "1", "--out", str(tmp_path / "made.npz")]
    result = CliRunner().invoke(app, made)
    assert result.exit_code == 0, result.output
    assert len(pictures(tmp_path / "arm.gif")) == 20, "the 10 s that were simulated"
    words += [*settings, "--commands", str(tmp_path / "set.npz")]
    result = CliRunner().invoke(app, [*words, "--id", "second"])
    assert result.exit_code == 0, result.output
    assert str(tmp_path / "arm.gif") in result.output
    assert pictures(tmp_path / "arm.gif")[0].shape == (240, 320, 3)
    for wrong in (["--size", "big"], ["--id", "none"], ["--case", "none"], ["--n", "2"]):
        result = CliRunner().invoke(app, [*words, *wrong])
        assert isinstance(result.exception, InputError)
        assert result.stderr == "", "the error's own line is the only one"


def test_skeleton_ends_at_the_end_effector(case: rt.Case, short: rt.Trajectories) -> None:
    body = case.body
    assert isinstance(body, ArmBody)
    nominal, _ = body.poses(short)
    points = body.skeleton(nominal)
    assert points.shape == (2, 150, 5, 3)
    np.testing.assert_allclose(points[..., -1, :], short.nominal, atol=1e-6)
    lengths = np.linalg.norm(np.diff(points, axis=2), axis=3)
    arm = body.twin.arm
    np.testing.assert_allclose(lengths, np.broadcast_to((arm.base, *arm.links), lengths.shape))


def test_observed_pose_meets_the_tip_and_is_nearest(case: rt.Case) -> None:
    body, rng = case.body, np.random.default_rng(8)
    commands = case.sampler.sample(12, rng=rng)[:, ::5]
    truth = np.deg2rad(rng.uniform(-4, 4, size=(12, 1, 4)))  # of every joint, all the while
    commanded = body.twin.angles(commands.astype(float))
    tip = body.twin.arm.position(commanded + truth)
    seen = rt.Trajectories(commands, body.twin.position(commands), tip, 20.0)
    nominal, observed = body.poses(seen)
    np.testing.assert_allclose(nominal, commanded)
    miss = np.linalg.norm(body.twin.arm.position(observed) - tip, axis=2)
    upright = np.hypot(tip[..., 0], tip[..., 1]) < 0.02
    assert miss[~upright].max() < 1e-4
    assert miss.max() < 2e-3
    stray = np.rad2deg(np.linalg.norm(observed - commanded, axis=2))
    true = np.rad2deg(np.linalg.norm(truth, axis=2))
    excess = (stray - true)[~upright]
    assert (excess < 0.2).mean() > 0.98, "no farther than the pose that was really there"
    assert excess.max() < 5
    steps = np.rad2deg(np.abs(np.diff(observed, axis=1)).max(axis=2))
    assert np.quantile(steps, 0.999) < 25


def test_pose_with_gaps_and_glitches(case: rt.Case, short: rt.Trajectories) -> None:
    body = case.body
    observed = short.observed.copy()
    observed[0, 40:60] = np.nan
    observed[1, 70] += (0.5, 0.0, 0.5)  # out of reach
    _, poses = body.poses(short.replace(observed=observed, mask=np.isfinite(observed)))
    assert np.isfinite(poses).all()
    tip = body.skeleton(poses)[..., -1, :]
    np.testing.assert_allclose(tip[0, 50], (tip[0, 39] + tip[0, 60]) / 2, atol=3e-3)
    np.testing.assert_allclose(tip[1, 80:], short.observed[1, 80:], atol=2e-3)
    with pytest.raises(InputError, match="commands: expected 4 channels"):
        body.poses(short.replace(commands=short.commands[..., :0], inputs=None))
