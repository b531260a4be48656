"""`Trajectories`: what is checked at the border, and what splitting and joining keep."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retwin.data.trajectories import Channels, Provenance, Trajectories
from retwin.errors import InputError


def make(n=6, steps=5, d_u=2, d_y=3, labels=None, **changes):
    rng = np.random.default_rng(0)
    parts = {
        "commands": rng.normal(size=(n, steps, d_u)),
        "nominal": rng.normal(size=(n, steps, d_y)),
        "observed": rng.normal(size=(n, steps, d_y)),
        "rate": 100.0,
        "labels": labels,
    }
    return Trajectories(**(parts | changes))


def broken(array, value, where=(1, 2, 0)):
    array = np.array(array)
    array[where] = value
    return array


def test_defaults_number_trajectories_and_channels():
    made = make(n=3)
    assert made.ids.tolist() == ["00000", "00001", "00002"]
    assert made.labels.tolist() == ["", "", ""]
    assert made.known_labels == frozenset()
    assert made.inputs == Channels(("u1", "u2"), ("1", "1"))
    assert made.outputs.names == ("y1", "y2", "y3")
    assert made.mask.all()
    assert len(made) == 3
    assert made.steps == 5
    assert repr(made) == "Trajectories(3, 5 samples at 100 Hz, commands 2, outputs 3)"


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_dtype_is_kept_and_whole_numbers_become_floats(dtype):
    made = make(nominal=np.ones((6, 5, 3), dtype), observed=np.ones((6, 5, 3), dtype))
    assert made.nominal.dtype == made.observed.dtype == made.residual.dtype == dtype
    assert make(commands=np.ones((6, 5, 2), int)).commands.dtype == np.float64


def test_missing_measurements_go_to_the_mask():
    made = make(observed=broken(make().observed, np.nan))
    assert not made.mask[1, 2, 0]
    assert made.mask.sum() == made.mask.size - 1
    assert made.observed[1, 2, 0] == 0
    assert made.residual[1, 2, 0] == 0
    np.testing.assert_allclose(made.residual[0], made.observed[0] - made.nominal[0])


def test_observed_is_zero_wherever_the_mask_says_missing():
    mask = np.ones((6, 5, 3), bool)
    mask[0, 3:] = False
    made = make(mask=mask)
    assert (made.observed[0, 3:] == 0).all()
    assert (made.observed[0, :3] != 0).all()


def test_arrays_are_read_only_and_the_callers_array_stays_writeable():
    mine = np.ones((6, 5, 2))
    made = make(commands=mine)
    for name in ("commands", "nominal", "observed", "mask", "labels", "ids"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(made, name)[0] = 0
    mine[0] = 2


@pytest.mark.parametrize(
    ("argument", "changes"),
    [
        ("commands", {"commands": broken(make().commands, np.nan)}),
        ("commands", {"commands": broken(make().commands, np.inf)}),
        ("commands", {"commands": np.ones((6, 4, 2))}),
        ("commands", {"commands": np.ones((5, 5, 2))}),
        ("commands", {"commands": np.ones((6, 5))}),
        ("commands", {"commands": np.full((6, 5, 2), "a")}),
        ("commands", {"commands": np.ones((6, 5, 2), complex)}),
        ("nominal", {"nominal": broken(make().nominal, np.nan)}),
        ("nominal", {"nominal": broken(make().nominal, -np.inf)}),
        ("observed", {"observed": broken(make().observed, np.inf)}),
        ("observed", {"observed": np.ones((6, 5, 2))}),
        ("mask", {"mask": np.ones((6, 5), bool)}),
        ("rate", {"rate": 0.0}),
        ("rate", {"rate": -1.0}),
        ("rate", {"rate": np.nan}),
        ("rate", {"rate": np.inf}),
        ("rate", {"rate": None}),
        ("rate", {"rate": "100"}),
        ("labels", {"labels": ["a"]}),
        ("ids", {"ids": ["a"] * 6}),
        ("ids", {"ids": ["a"]}),
        ("inputs", {"inputs": Channels(("a",), ("1",))}),
        ("outputs", {"outputs": Channels.numbered("y", 4)}),
    ],
)
def test_bad_input_names_the_argument_in_one_line(argument, changes):
    with pytest.raises(InputError) as caught:
        make(**changes)
    assert caught.value.argument == argument
    message = str(caught.value)
    assert message.startswith(f"{argument}: expected ")
    assert ", got " in message
    assert "\n" not in message


def test_the_place_of_a_bad_value_is_named():
    with pytest.raises(InputError, match="trajectory 1, sample 2, channel 0"):
        make(nominal=broken(make().nominal, np.nan))


@pytest.mark.parametrize("steps", [0, 1])
def test_a_trajectory_has_at_least_two_samples(steps):
    with pytest.raises(InputError, match="at least two samples"):
        make(steps=steps)


def test_channels_are_named_once_with_a_unit_each():
    with pytest.raises(InputError, match="no name twice"):
        Channels(("a", "a"), ("m", "m"))
    with pytest.raises(InputError, match="one unit per name"):
        Channels(("a", "b"), ("m",))


def test_errors_survive_a_process_border():
    error = InputError("rate", expected="a number", got="none", remedy="give one")
    again = pickle.loads(pickle.dumps(error))  # what multiprocessing does
    assert isinstance(again, InputError)
    assert str(again) == str(error) == "rate: expected a number, got none; give one"
    assert again.remedy == "give one"


def test_index_by_slice_numbers_flags_and_nothing():
    made = make(labels=list("aabbcc"))
    assert made[1:3].ids.tolist() == ["00001", "00002"]
    assert made[[4, 0]].ids.tolist() == ["00004", "00000"]
    assert made[3].labels.tolist() == ["b"]
    assert made[np.array([True] + [False] * 5)].ids.tolist() == ["00000"]
    assert len(made[[]]) == len(made.with_label("z")) == 0
    np.testing.assert_array_equal(made.with_label("b").commands, made.commands[2:4])


def test_replace_checks_again():
    made = make()
    assert made.replace(rate=50.0).rate == 50
    assert made.rate == 100
    with pytest.raises(InputError, match="rate"):
        made.replace(rate=-1)


labelled = st.lists(st.sampled_from("abcd"), min_size=2, max_size=40)


@settings(max_examples=60, deadline=None)
@given(labelled, st.floats(0.05, 0.95), st.integers(0, 10))
def test_split_is_a_stratified_partition(labels, fraction, seed):
    made = make(n=len(labels), steps=2, d_u=1, d_y=1, labels=labels)
    first, second = (made[index] for index in made.split_index(fraction, seed=seed))
    assert sorted([*first.ids, *second.ids]) == sorted(made.ids)
    for label in set(labels):
        share = fraction * labels.count(label)
        # Half a trajectory carried over from the class before, half from rounding.
        assert abs(len(first.with_label(label)) - share) <= 1 + 1e-9
    assert abs(len(first) - fraction * len(labels)) <= 0.5 + 1e-9
    again = made[made.split_index(fraction, seed=seed)[0]]
    assert again.ids.tolist() == first.ids.tolist()


def test_split_depends_on_the_seed_and_keeps_the_order():
    made = make(n=40, labels=["a", "b"] * 20)
    firsts = [made.split(0.5, seed=seed)[0].ids.tolist() for seed in range(5)]
    assert len({tuple(ids) for ids in firsts}) > 1
    assert all(ids == sorted(ids) for ids in firsts)


@pytest.mark.parametrize("fraction", [0, 1, -0.1, 1.1, float("nan")])
def test_split_refuses_shares_that_leave_nothing(fraction):
    with pytest.raises(InputError, match="strictly between 0 and 1"):
        make().split(fraction, seed=0)


@pytest.mark.parametrize("fraction", [1e-300, 0.01, 0.99, 1 - 1e-15])
def test_split_refuses_shares_too_small_for_these(fraction):
    with pytest.raises(InputError, match="leaves some of the 4 trajectories to both sets, got"):
        make(n=4).split(fraction, seed=0)


@settings(max_examples=60, deadline=None)
@given(labelled, st.data())
def test_folds_test_every_trajectory_once(labels, data):
    made = make(n=len(labels), steps=2, d_u=1, d_y=1, labels=labels)
    count = data.draw(st.integers(2, len(labels)))
    folds = made.folds(count, seed=1)
    assert len(folds) == count
    assert sorted(np.concatenate([test for _, test in folds])) == list(range(len(labels)))
    for calibration, test in folds:
        assert sorted([*calibration, *test]) == list(range(len(labels)))
    for label in set(labels):
        per_fold = [(made.labels[test] == label).sum() for _, test in folds]
        assert max(per_fold) - min(per_fold) <= 1
    sizes = [len(test) for _, test in folds]
    assert max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize("count", [1, 7, 0, 2.5])
def test_folds_refuse_a_count_that_cannot_be(count):
    with pytest.raises(InputError, match="whole number from 2 to 6"):
        make().folds(count, seed=0)


def test_concatenate_joins_and_renumbers_only_when_ids_repeat():
    source = Provenance("a.mat", "00")
    one = make(labels=["a"] * 6, provenance=(source,))
    other = make(labels=["long name"] * 6, provenance=(source, Provenance("b")), emulated=True)
    both = Trajectories.concatenate([one, other])
    assert len(both) == 12
    assert len(set(both.ids.tolist())) == 12
    assert both.labels.tolist() == ["a"] * 6 + ["long name"] * 6
    assert both.provenance == (source, Provenance("b"))
    assert both.emulated
    named = one.replace(ids=list("abcdef"))
    assert Trajectories.concatenate([named, other]).ids[0] == "a"


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("rate", {"rate": 50.0}),
        ("inputs", {"d_u": 1}),
        ("outputs", {"d_y": 2}),
    ],
)
def test_concatenate_refuses_sets_that_differ(name, other):
    with pytest.raises(InputError) as caught:
        Trajectories.concatenate([make(), make(**other)])
    assert caught.value.argument == f"sets.{name}"


def test_concatenate_pads_shorter_sets():
    both = Trajectories.concatenate([make(), make(steps=4)])
    assert both.steps == make().steps
    assert both.lengths.tolist() == [make().steps] * len(make()) + [4] * len(make(steps=4))
    short = both[slice(len(make()), None)]
    assert not short.mask[:, 4:].any()
    np.testing.assert_array_equal(
        short.nominal[:, 4:], short.nominal[:, 3:4].repeat(short.steps - 4, 1)
    )


@pytest.mark.parametrize("rate", [0.3, 100.0])
def test_a_stretch_of_time_is_cut_out(rate):
    whole = make().replace(rate=rate)
    part = whole.between(2 / rate, 5 / rate)
    for name in ("commands", "nominal", "observed", "mask"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[:, 2:5])
    assert (part.rate, part.ids.tolist()) == (rate, whole.ids.tolist())
    np.testing.assert_array_equal(whole.between(3 / rate).nominal, whole.nominal[:, 3:])
    np.testing.assert_array_equal(whole.between().observed, whole.observed)
    end = whole.steps / rate
    for times in ((-1 / rate,), (end,), (0.0, end + 1 / rate), (3 / rate, 2 / rate), (np.nan,)):
        with pytest.raises(InputError, match=f"in order, from 0 to {end:g}"):
            whole.between(*times)
    with pytest.raises(InputError, match="two samples"):
        whole.between(0.0, 1 / rate)


def test_only_channels_of_one_real_unit_compare():
    assert Channels(("x", "y"), ("m", "m")).comparable
    assert not Channels(("x", "a"), ("m", "rad")).comparable
    assert not Channels.numbered("y", 2).comparable, "what has no unit may be anything"
    assert Channels.numbered("y", 1).comparable


def test_concatenate_needs_a_set():
    with pytest.raises(InputError, match="at least 1 set"):
        Trajectories.concatenate([])
