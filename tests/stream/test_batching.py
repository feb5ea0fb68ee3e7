"""Several items in one request: taken apart, answered one by one, never half answered."""

import pytest

from icrl_dist.stream import batching
from icrl_dist.stream.validation import WireError, pack


class Asked:
    key = "data"

    def __init__(self, payload):
        self.payload, self.answers = payload, []

    def reply(self, payload):
        self.answers.append(payload)


def test_items_come_apart_and_the_answers_together_in_their_order():
    items = [b"one", b"", b"\xc1" * 1000]
    asked = Asked(batching.join(items))
    parts = batching.split(asked, 1 << 20)
    assert [part.payload for part in parts] == items and {part.key for part in parts} == {"data"}
    parts[2].refuse("spec: no")
    parts[0].reply(b"stored")
    assert asked.answers == []
    parts[1].refuse("")
    assert [batching.reasons(a, 3) for a in asked.answers] == [["", "refused", "spec: no"]]
    with pytest.raises(RuntimeError, match=r"item 2 .* answered before"):
        parts[2].reply(b"stored")


def test_no_items_are_answered_at_once():
    asked = Asked(batching.join([]))
    assert batching.split(asked, 100) == [] and batching.reasons(asked.answers[0], 0) == []


@pytest.mark.parametrize(
    ("reason", "answer"),
    [
        ("not-msgpack", b"stored"),
        ("schema", pack("answers", {"reasons": ["", ""]})),
        ("schema", pack("answers", {"reasons": [1]})),
        ("schema", pack("answers", {"results": [""]})),
    ],
)
def test_an_answer_that_is_none_is_told(reason, answer):
    with pytest.raises(WireError) as caught:
        batching.reasons(answer, 1)
    assert caught.value.reason == reason
