"""The episodes that the estimator has learned from: all are drawn from, and a successor draws the same."""

from pathlib import Path

import torch
from caraware.fusion.carrier import COLUMNS
from caraware.fusion.past import FOLDER, Episode, Past

TICKS, SLOTS = 4, 3


def episode(number: int) -> Episode:
    """One whose rows all hold its number."""
    return Episode(
        torch.full((TICKS, SLOTS, COLUMNS), float(number)),
        torch.full((TICKS, SLOTS, 2), float(number)),
        torch.ones(TICKS, SLOTS),
    )


def numbers(drawn: Episode) -> list[int]:
    """The episode of each piece drawn."""
    assert torch.equal(drawn.table[..., :2], drawn.truth_m)
    return [int(n) for n in drawn.truth_m[0, :, 0]]


def past_of(run_dir: Path | None, *present: int, most_rows: int = 10**6) -> Past:
    past = Past(run_dir / FOLDER if run_dir else None, most_rows)
    for number in present:
        past.add(number, episode(number))
    return past


def files(run_dir: Path) -> list[int]:
    return sorted(int(file.stem) for file in (run_dir / FOLDER).iterdir())


def test_a_batch_is_drawn_from_all_episodes_and_holds_no_piece_twice() -> None:
    past, generator = past_of(None, 1, 2, 3), torch.Generator().manual_seed(1)
    assert sorted(numbers(past.draw(100, generator))) == [1] * SLOTS + [2] * SLOTS + [3] * SLOTS
    draws = [numbers(past.draw(4, generator)) for _ in range(200)]
    assert all(len(drawn) == 4 and max(map(drawn.count, drawn)) <= SLOTS for drawn in draws)
    # Each of three episodes has a third of 800: 267, and a standard deviation of less than 13.
    assert all(abs(sum(drawn.count(n) for drawn in draws) - 267) < 5 * 13 for n in (1, 2, 3))


def test_pieces_that_hold_no_row_that_counts_are_left_out() -> None:
    one = episode(1)
    one.valid[:, 1] = 0.0
    assert one.pieces(TICKS).valid.shape == (TICKS, SLOTS - 1)
    assert one.pieces(3).valid.sum() == TICKS * (SLOTS - 1)


def test_the_oldest_are_forgotten_and_their_files_go_with_the_next_commit(tmp_path: Path) -> None:
    past = past_of(tmp_path, 1, 2, 3, most_rows=2 * TICKS * SLOTS)
    assert sorted(set(numbers(past.draw(100, torch.Generator())))) == [2, 3]
    assert files(tmp_path) == [1, 2, 3]
    past.tidy()
    assert files(tmp_path) == [2, 3]


def test_a_successor_draws_what_its_predecessor_would_have_drawn(tmp_path: Path) -> None:
    whole = past_of(tmp_path, 1, 2, 3, 4)
    successor = Past(tmp_path / FOLDER)
    successor.load(tmp_path, updates=3)
    expected = past_of(None, 1, 2, 3)
    assert numbers(successor.draw(5, torch.Generator())) == numbers(expected.draw(5, torch.Generator()))
    successor.add(4, episode(4))
    assert numbers(successor.draw(5, torch.Generator())) == numbers(whole.draw(5, torch.Generator()))


def test_a_damaged_file_is_left_out(tmp_path: Path) -> None:
    past_of(tmp_path, 1, 2)
    (tmp_path / FOLDER / "000001.safetensors").write_bytes(b"no tensors")
    past = Past()
    past.load(tmp_path, updates=2)
    assert set(numbers(past.draw(100, torch.Generator()))) == {2}
    past.load(tmp_path / "of no run", updates=2)


def test_episodes_of_another_run_are_copied(tmp_path: Path) -> None:
    past_of(tmp_path / "old", 1, 2)
    past = Past(tmp_path / "new" / FOLDER)
    past.load(tmp_path / "old", updates=2)
    assert files(tmp_path / "new") == [1, 2]
    past.tidy()
    assert files(tmp_path / "old") == [1, 2]
