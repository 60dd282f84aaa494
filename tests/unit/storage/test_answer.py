"""An answer of the record is waited for, refused, and followed up as Python's own future would be."""

import threading

import pytest

from scanner_service.storage.answer import Answer, give


def test_answers_given_together_are_there_for_whoever_waits_and_are_followed_up_once():
    door = threading.Condition()
    answers = [Answer(door) for _ in range(3)]
    heard, seen = [], []
    waiting = [
        threading.Thread(target=lambda one=one: heard.append(one.exception(60) or one.result())) for one in answers
    ]
    for thread in waiting:
        thread.start()
    for answer in answers:
        answer.add_done_callback(lambda done: 1 / 0)  # must keep nobody else from it
        answer.add_done_callback(seen.append)
    with pytest.raises(TimeoutError):
        answers[0].result(0.01)
    assert not any(answer.done() for answer in answers) and not seen
    refusal = ValueError("no")
    give(answers, ["first", refusal, None], door)
    for thread in waiting:
        thread.join(60)
    assert seen == answers
    assert len(heard) == 3 and "first" in heard and refusal in heard
    assert (answers[0].result(), answers[0].exception(), answers[2].result()) == ("first", None, None)
    with pytest.raises(ValueError, match="no"):
        answers[1].result()
    answers[2].add_done_callback(seen.append)  # it is there: at once
    assert seen == [*answers, answers[2]]
