"""Faults of a heated box, whose inner temperature nobody measures: found, sized, dated, or unknown.

The emulated box has a nonlinear loss, which its twin lacks.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.special import softmax
from test_readme import python_of

import retwin as rt
from retwin.diagnosis import StateDiagnosis, StateInversionDiagnoser
from retwin.diagnosis.inversion.fault_evidence import FaultEvidence
from retwin.errors import InputError
from retwin.twins import (
    ActuatorGain,
    HoldSampler,
    Parameter,
    ParameterShift,
    ParametricTwin,
    SensorBias,
    SensorDrift,
    SensorFreeze,
    State,
    StateTwin,
    Stuck,
    draw_faults,
    faulty_commands,
)
from retwin.twins.faults.system_faults import measured_with
from retwin.update import Dynamics, Library, fit_dynamics

pytestmark = pytest.mark.slow  # they stand on one long fit

RATE, STEPS, KNOWN, EACH = 2.0, 160, 4, 3
NOISE = 0.02
BOUNDS = {"low": -1.0, "high": 3.0}
CALIBRATED = ("power", "between", "loss")


def box(loss) -> StateTwin:
    """A box with an inner and an outer temperature, of which the outer one is measured."""

    def derivative(x, u, p):
        flow = p.between * (x.inner - x.outer)
        return p.power * u.heat - flow, flow - loss(x, p) - p.leak * x.outer

    return StateTwin(
        (State("inner", "K", 0.5, **BOUNDS), State("outer", "K", 0.5, **BOUNDS)),
        lambda x, u: (x.outer, u.heat * 0.5),
        rt.Channels(("heat",), ("W",)),
        rt.Channels(("air", "current"), ("K", "A")),
        RATE,
        derivative=derivative,
        parameters=(
            Parameter("power", "K/(W s)", 0.01, 1.0, start=0.1),
            Parameter("between", "1/s", 0.01, 1.0, start=0.2),
            Parameter("loss", "1/s", 0.01, 1.0, start=0.1),
            Parameter("leak", "1/s", -1.0, 1.0, start=0.0),
        ),
    )


TWIN = box(lambda x, p: p.loss * x.outer)
REAL = box(lambda x, p: p.loss * x.outer * (1 + 0.15 * x.outer))
OPEN = {"onset": (15.0, 50.0)}
FAULTS: dict[str, rt.Fault | None] = {
    "Healthy": None,
    "leak": ParameterShift("leak", size=(0.02, 0.06), **OPEN),
    "weak": ActuatorGain(0, size=(-0.5, -0.2), **OPEN),
    "biased": SensorBias(0, size=(0.1, 0.4), **OPEN),
    "drifting": SensorDrift(0, size=(0.005, 0.02), **OPEN),
    "frozen": SensorFreeze(0, **OPEN),
}


def recorded(seed: int) -> tuple[rt.Trajectories, list]:
    """Healthy records for calibration, and `EACH` of every class; what each has."""
    rng = np.random.default_rng(seed)
    sampler = HoldSampler((0.0,), (2.0,), RATE, STEPS / RATE, hold_durations=(5.0, 20.0))
    labels = ["Healthy"] * KNOWN + [name for name in FAULTS for _ in range(EACH)]
    commands = sampler.sample(len(labels), rng=rng).astype(float)
    segments = rt.Segments.from_commands(commands)
    faults = draw_faults([FAULTS[name] for name in labels], segments, seed, rate=RATE)
    starts = rng.uniform(0, 1, size=(2, len(labels)))
    values = REAL.values({"start_inner": starts[0], "start_outer": starts[1]}, len(labels))
    kicks = 0.005 * rng.normal(size=(*commands.shape[:2], 2))
    effective = faulty_commands(commands, faults, segments, rate=RATE)
    changes = REAL.changes(faults, STEPS)
    outputs = REAL.steps().run(effective, values, kicks, changes)[0]
    outputs = outputs + NOISE * rng.normal(size=outputs.shape)
    made = rt.Trajectories(
        commands=commands,
        nominal=TWIN.simulate(commands, seed=0).nominal,
        observed=measured_with(outputs, faults, RATE),
        labels=np.array(labels),
        rate=RATE,
        inputs=TWIN.inputs,
        outputs=TWIN.outputs,
    )
    return made, faults


@pytest.fixture(scope="module")
def records() -> tuple[rt.Trajectories, list]:
    return recorded(0)


@pytest.fixture(scope="module")
def diagnoser(records) -> StateInversionDiagnoser:
    free = tuple(each for each in TWIN.free if each.name != "leak")
    fitted = fit_dynamics(
        ParametricTwin(TWIN, free), records[0][:KNOWN], Dynamics(Library(degree=2, knots=()))
    )
    return rt.fit_inversion(fitted.twin, None, None, FAULTS)


@pytest.fixture(scope="module")
def diagnosis(diagnoser, records) -> StateDiagnosis:
    return diagnoser.diagnose(records[0][KNOWN:])


def test_faults_are_found(diagnosis, records) -> None:
    best = np.array(diagnosis.classes)[diagnosis.probabilities.argmax(axis=1)]
    labels = records[0].labels[KNOWN:]
    assert np.mean(best == labels) >= 0.9
    assert (diagnosis.unknown[labels == "Healthy"] < 0.5).all()
    # The twin lacks the nonlinear loss, so that a fault beyond the calibration can be unknown.
    assert np.mean(diagnosis.unknown < 0.5) >= 0.65
    np.testing.assert_allclose(diagnosis.probabilities.sum(axis=1), 1.0)


def test_sizes_and_onsets_are_in_their_intervals(diagnosis, records) -> None:
    made, faults = records
    inside: dict[str, list[bool]] = {"size": [], "onset": []}
    for i, (label, fault) in enumerate(zip(made.labels[KNOWN:], faults[KNOWN:], strict=True)):
        for name, held in inside.items():
            if hasattr(fault, name):
                found, column = getattr(diagnosis, name), diagnosis.classes.index(label)
                # A sample period is what an onset between two samples cannot be resolved to.
                margin = 1 / RATE if name == "onset" else 0.0
                low, high = found.low[i, column] - margin, found.high[i, column] + margin
                held.append(low <= getattr(fault, name) <= high)
    # 90 % intervals: fewer than 5 of 12 sizes or 7 of 15 onsets have a probability of 3e-6.
    assert (len(inside["size"]), len(inside["onset"])) == (12, 15)
    assert np.sum(inside["size"]) >= 5
    assert np.sum(inside["onset"]) >= 7


def test_a_fault_that_is_not_known_is_unknown(diagnoser, records) -> None:
    made = records[0][KNOWN:]
    faults = {name: each for name, each in FAULTS.items() if name != "weak"}
    some = made[np.isin(made.labels, ("Healthy", "weak", "biased"))]
    found = StateInversionDiagnoser(diagnoser.twin, faults).diagnose(some)
    unknown = found.unknown[some.labels == "weak"], found.unknown[some.labels != "weak"]
    assert np.mean(unknown[0][:, None] > unknown[1]) >= 0.9
    assert (found.labels[some.labels == "weak"] == "unknown").mean() >= 0.6


def test_a_window_of_a_record_is_diagnosed_without_its_start(diagnoser, records) -> None:
    made = records[0][KNOWN:]
    weak = made[made.labels == "weak"].between(50.0)
    fault = ActuatorGain(0, size=(-0.5, -0.2))
    physics = StateInversionDiagnoser(diagnoser.twin, {"Healthy": None, "weak": fault})
    found = physics.diagnose(weak, known_start=False)
    assert (found.probabilities[:, 1] > 0.9).mean() >= 0.8
    healthy = made[made.labels == "Healthy"].between(50.0)
    assert (physics.diagnose(healthy, known_start=False).probabilities[:, 0] > 0.9).mean() >= 0.8


def test_an_end_is_inferred(diagnoser, records) -> None:
    made = records[0][:1]
    times = {"onset": (5.0, 40.0), "end": (30.0, 75.0)}
    real = SensorBias(0, size=0.3, onset=20.0, end=60.0)
    seen = made.replace(observed=measured_with(made.observed, [real], RATE))
    faults = {"Healthy": None, "biased": SensorBias(0, size=(0.1, 0.5), **times)}
    found = StateInversionDiagnoser(diagnoser.twin, faults).diagnose(seen)
    assert found.probabilities[0, 1] > 0.99
    for name, wanted in (("size", 0.3), ("onset", 20.0), ("end", 60.0)):
        assert getattr(found, name).value[0, 1] == pytest.approx(wanted, abs=0.1 + 0.02 * wanted)


def test_missing_samples_do_not_count(diagnoser, records) -> None:
    made = records[0][KNOWN : KNOWN + 1]
    mask = made.mask.copy()
    mask[0, ::3] = False
    sparse = made.replace(mask=mask)
    wrong = sparse.observed.copy()
    wrong[~mask] = 1e3
    few = {name: FAULTS[name] for name in ("Healthy", "biased")}
    physics = StateInversionDiagnoser(diagnoser.twin, few)
    one, other = (physics.diagnose(e) for e in (sparse, sparse.replace(observed=wrong)))
    np.testing.assert_array_equal(one.evidence, other.evidence)
    assert one.probabilities[0, 0] > 0.5


def test_an_output_that_is_not_measured_does_not_count(diagnoser, records) -> None:
    made = records[0][KNOWN : KNOWN + 1]
    mask = made.mask.copy()
    mask[..., 1] = False
    found = diagnoser.diagnose(made.replace(mask=mask))
    assert found.probabilities[0, 0] > 0.5
    assert np.isfinite(found.evidence).all()


@pytest.mark.parametrize(("value", "message"), [(3.4e38, "finite"), (np.nan, "measured samples")])
def test_outputs_of_no_use_are_refused(diagnoser, records, value: float, message: str) -> None:
    made = records[0][:1]
    wrong = np.where(np.arange(STEPS)[:, None] == 7, value, made.observed)
    mask = np.full_like(made.mask, np.isfinite(value))
    with pytest.raises(InputError, match=message):
        diagnoser.diagnose(made.replace(observed=np.nan_to_num(wrong, nan=0.0), mask=mask))


def test_commands_beyond_the_calibration_are_marked(diagnoser, records) -> None:
    made = records[0][:1]
    beyond = made.replace(commands=1.5 * made.commands)
    assert diagnoser.twin.outside(beyond.commands).tolist() == [True]
    assert diagnoser.twin.outside(made.commands).tolist() == [False]


def test_it_is_saved(diagnoser, records, tmp_path) -> None:
    diagnoser.save(tmp_path / "physics")
    again = rt.load_diagnoser(tmp_path / "physics")
    some = records[0][KNOWN : KNOWN + 1]
    np.testing.assert_array_equal(again.predict_proba(some), diagnoser.predict_proba(some))


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        ({"Healthy": None}, "one healthy class"),
        ({"leak": FAULTS["leak"], "weak": FAULTS["weak"]}, "one healthy class"),
        ({"Healthy": None, "stuck": Stuck(0)}, "ParameterShift"),
        ({"Healthy": None, "lost": ParameterShift("lost", size=1.0)}, "one of the parameters"),
        ({"Healthy": None, "third": SensorBias(2, size=1.0)}, "output from 0 to 1"),
    ],
)
def test_faults_that_cannot_be_inverted_are_refused(diagnoser, faults, message: str) -> None:
    with pytest.raises(InputError, match=message):
        StateInversionDiagnoser(diagnoser.twin, faults)


def test_records_of_another_system_are_refused(diagnoser, records) -> None:
    other = records[0].replace(outputs=rt.Channels(("air", "voltage"), ("K", "V")))
    with pytest.raises(InputError, match="outputs"):
        diagnoser.diagnose(other)
    late = {"Healthy": None, "late": replace(FAULTS["leak"], onset=500.0)}
    with pytest.raises(InputError, match="onset"):
        StateInversionDiagnoser(diagnoser.twin, late).diagnose(records[0][:1])


def test_a_twin_of_which_no_distribution_is_known_is_refused(records) -> None:
    with pytest.raises(InputError, match="give fit_dynamics"):
        rt.fit_inversion(TWIN, None, records[0], FAULTS)


def test_the_page_of_faults() -> None:
    names: dict = {"__name__": "shown"}
    for code in python_of("diagnose", "Faults of any system"):
        exec(compile(code, "docs/diagnose.md", "exec"), names)
    found, drawn = names["found"], names["records"].labels[5:]
    assert np.diag(found.probabilities).min() > 0.9
    assert (found.unknown < 0.5).all()
    assert len(drawn) == len(found.classes)


def test_sizes_are_in_their_intervals_where_errors_depend_on_each_other(
    diagnoser, records, diagnosis
) -> None:
    """Noise of an autocorrelation that the twin lacks: 0.42 of the intervals as if it were none."""
    made, faults = records
    white = np.random.default_rng(0).normal(size=made.observed.shape)
    noise = 2 * NOISE * lfilter([np.sqrt(1 - 0.9**2)], [1, -0.9], white, axis=1)
    found = diagnoser.diagnose(made.replace(observed=made.observed + noise)[KNOWN:])
    inside, wider = [], []
    for i, (label, fault) in enumerate(zip(made.labels[KNOWN:], faults[KNOWN:], strict=True)):
        if hasattr(fault, "size"):
            place = found.classes.index(label)
            low, high = found.size.low[i, place], found.size.high[i, place]
            inside.append(low <= fault.size <= high)
            before = diagnosis.size.high[i, place] - diagnosis.size.low[i, place]
            wider.append((high - low) / before)
    assert np.mean(inside) >= 0.75
    assert np.median(wider) < 8
    # Samples that are not each new say less of which fault it is than their evidence.
    raw = softmax(found.evidence[:, :-1], axis=1).max(axis=1)
    assert (found.probabilities.max(axis=1) <= raw + 1e-9).all()
    assert np.median(raw - found.probabilities.max(axis=1)) > 1e-3


@pytest.mark.parametrize("frozen", [True, False])
def test_a_sensor_at_rest_that_has_its_noise_is_not_frozen(frozen: bool) -> None:
    """The noise of the twin contains what it lacks, and is much larger than that of the sensor."""
    count = 100
    sensor = np.full(count, 0.3) if frozen else np.random.default_rng(3).normal(0.3, 0.05, count)
    record = SimpleNamespace(measured=sensor[:, None], seen=np.ones((count, 1), dtype=bool))
    evidence = SimpleNamespace(record=record, twin=SimpleNamespace(noise=np.array([1.0])))
    active, seen = np.ones(count, dtype=bool), record.seen.copy()
    found = FaultEvidence._density_frozen(evidence, 0, active, seen)  # type: ignore[arg-type]
    exact = -0.5 * (count - 1) * np.log(2 * np.pi)  # of a twin that predicts each sample exactly
    assert abs(found - exact) > 10
    assert (found > exact) == frozen
