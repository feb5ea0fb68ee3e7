"""Text drawings, compared with slow and obvious loops."""

import numpy as np
import pytest

from icrl_dist.monitor.spark import BLOCKS, bar, bounds, plot, resample, room, spark


def _cases():
    rng = np.random.default_rng(3)
    for length in (0, 1, 2, 7, 40, 200):
        for width in (1, 5, 33):
            values = rng.normal(3.0, 4.0, length).tolist()
            yield [None if rng.random() < 0.2 else value for value in values], width


@pytest.mark.parametrize(("values", "width"), list(_cases()))
def test_a_bucket_is_the_mean_of_its_values(values, width):
    means = resample(values, width)
    assert len(means) == min(width, len(values))
    for bucket, mean in enumerate(means):
        inside = []
        for i, value in enumerate(values):
            in_bucket = (
                i == bucket
                if len(values) <= width
                else bucket * len(values) // width <= i < (bucket + 1) * len(values) // width
            )
            if in_bucket and value is not None:
                inside.append(value)
        assert mean == pytest.approx(sum(inside) / len(inside)) if inside else mean is None


@pytest.mark.parametrize("height", [1, 2, 5])
@pytest.mark.parametrize(("values", "width"), list(_cases()))
def test_a_plot_fills_one_eighth_for_every_step_below_the_value(values, width, height):
    low, high = bounds(values, 9.0)
    drawn = plot(values, width, height, low, high)
    assert len(drawn) == height
    for column, value in enumerate(resample(values, width)):
        filled = sum(BLOCKS.index(line[column]) for line in drawn)
        if value is None:
            assert filled == 0
            continue
        passed = 0
        for eighth in range(1, 8 * height):  # the first eighth is always filled
            passed += value >= low + (high - low) * eighth / (8 * height) - 1e-9
        assert filled == passed + 1
    if height == 1:
        assert drawn[0] == spark(values, width, low, high)


def test_a_plot_has_no_holes():
    drawn = plot([0.0, 1.0, 2.0, 3.0, 4.0], 5, 3, 0.0, 4.0)
    assert drawn == ["   ▃█", "  ▅██", "▁▇███"]
    for column in range(5):
        heights = [BLOCKS.index(line[column]) for line in drawn]
        assert heights == sorted(heights), "the cells below a block are full"


@pytest.mark.parametrize(
    ("values", "ceiling", "expected"),
    [([], None, (0.0, 1.0)), ([2.0, None], None, (0.0, 2.0)), ([-3.0], 5.0, (-3.0, 5.0)), ([7.0], 5.0, (0.0, 7.0))],
)
def test_the_bounds_include_zero_and_the_ceiling(values, ceiling, expected):
    assert bounds(values, ceiling) == expected


def test_values_beyond_the_bounds_are_clipped():
    assert spark([-5.0, 0.0, 1.0, 9.0], 4, 0.0, 1.0) == "▁▁██"
    assert spark([3.0, 3.0], 4, 3.0, 3.0) == "▁▁"


@pytest.mark.parametrize(("share", "done"), [(-1.0, 0), (0.0, 0), (0.49, 5), (1.0, 10), (3.0, 10)])
def test_a_bar_is_as_long_as_its_share(share, done):
    assert [len(part) for part in bar(share, 10)] == [done, 10 - done]


def test_a_room_is_drawn_from_above():
    path = [[0, 0], [0, 1], [1, 1], [1, 1], [1, 0]]
    rows = room(3, [1, 1], path, [False, True, False, True])
    assert rows == [
        [("·", "empty"), ("·", "empty"), ("·", "empty")],
        [("1", "path"), ("2", "goal"), ("·", "empty")],
        [("0", "start"), ("4", "moved"), ("·", "empty")],
    ]
    assert room(2, [1, 1], [[0, 0]], []) == [[("·", "empty"), ("G", "goal")], [("0", "start"), ("·", "empty")]]
