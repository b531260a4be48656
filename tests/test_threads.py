"""Work in threads: order, turns, failures, and one thread inside each."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
import torch

import retwin as rt
from retwin.workers.threads import Turns, available, in_threads, one_thread


@pytest.fixture(params=[1, 3])
def count(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_results_are_in_order_and_each_part_has_one_thread(count: int) -> None:
    def part(number: int) -> tuple[int, int, int]:
        time.sleep(0.01 * (number % 3))
        return number, available(), torch.get_num_threads()

    assert list(in_threads(part, range(9))) == [(number, 1, 1) for number in range(9)]
    assert torch.get_num_threads() == available() == count


@pytest.mark.usefixtures("count")
def test_blocks_of_one_thread_that_overlap_restore_the_number() -> None:
    before, inside, found = torch.get_num_threads(), threading.Event(), []

    def first() -> None:
        with one_thread():
            inside.set()
            time.sleep(0.1)

    def second() -> None:
        inside.wait()
        with one_thread():
            time.sleep(0.2)

    def third() -> None:  # begins when both have ended
        found.append(torch.get_num_threads())

    for group in ((first, second), (third,)):
        threads = [threading.Thread(target=each) for each in group]
        for each in threads:
            each.start()
        for each in threads:
            each.join()
    assert found == [before] == [torch.get_num_threads()]


@pytest.mark.usefixtures("count")
def test_turns_follow_the_items_and_a_failure_ends_the_work() -> None:
    turns, drawn = Turns(), []

    def part(number: int) -> None:
        time.sleep(0.01 * (3 - number % 3))
        try:
            if number == 5:
                raise ValueError("of part 5")
            if number != 2:  # needs no turn
                with turns.turn(number):
                    drawn.append(number)
        finally:
            turns.over(number)

    with pytest.raises(ValueError, match="of part 5"):
        list(in_threads(part, range(9)))
    assert drawn[:4] == [0, 1, 3, 4]
    assert drawn == sorted(drawn)


@pytest.mark.slow
def test_a_corrected_twin_gives_the_same_bytes_with_any_number_of_threads() -> None:
    case, before = rt.cases.armpi(), torch.get_num_threads()
    brief = rt.Training(max_epochs=5)
    simulated = rt.generate(case.emulator, case, per_class=10, seed=0)
    ibg = rt.fit_surrogate(simulated, seed=0, training=brief)
    twin = rt.CorrectedTwin(ibg, rt.fit_residual(ibg, simulated, seed=0))
    found = []
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            made = rt.generate(twin, case, per_class=40, seed=1)
            found.append((made.nominal.tobytes(), made.observed.tobytes()))
    finally:
        torch.set_num_threads(before)
    assert found[0] == found[1]
