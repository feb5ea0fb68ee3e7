"""Several items in one request: split, answered one by one, replied to once all are answered."""

import pytest

from icrl_dist.stream import batching
from icrl_dist.stream.validation import WireError, pack


class RecordedQuery:
    key = "data"

    def __init__(self, payload):
        self.payload, self.answers = payload, []

    def reply(self, payload):
        self.answers.append(payload)

    def refuse(self, reason):
        raise AssertionError(f"the request was refused: {reason}")


def test_items_are_split_and_their_answers_come_back_in_order():
    items = [b"one", b"", b"\xc1" * 1000]
    query = RecordedQuery(batching.join(items))
    parts = batching.split(query, 1 << 20)
    assert [part.payload for part in parts] == items and {part.key for part in parts} == {"data"}
    parts[2].refuse("spec: no")
    parts[0].reply(b"stored")
    assert query.answers == []
    parts[1].refuse("")
    assert [batching.reasons(a, 3) for a in query.answers] == [["", "refused", "spec: no"]]
    with pytest.raises(RuntimeError, match=r"item 2 .* answered before"):
        parts[2].reply(b"stored")


def test_a_request_without_items_is_answered_at_once():
    query = RecordedQuery(batching.join([]))
    assert batching.split(query, 100) == [] and batching.reasons(query.answers[0], 0) == []


@pytest.mark.parametrize(
    ("reason", "answer"),
    [
        ("not-msgpack", b"stored"),
        ("schema", pack("answers", {"reasons": ["", ""]})),
        ("schema", pack("answers", {"reasons": [1]})),
        ("schema", pack("answers", {"results": [""]})),
    ],
)
def test_an_invalid_answer_is_refused(reason, answer):
    with pytest.raises(WireError) as caught:
        batching.reasons(answer, 1)
    assert caught.value.reason == reason
