"""The benchmark of latency: every line is sent, answered and accounted for; what it measures is not judged here."""

import json

import numpy as np
import pytest

from benchmarks.latency import Answers, compare, lost_lines, main
from benchmarks.prepared_scanner import PassPlan, Sent, leaving_times_s, prepare
from drivers.protocols.native import Decoder, encode
from drivers.protocols.native_messages import Chunk, EndOfPass, Hello, Keepalive, Laser, Start
from tests.singles import apart


def test_a_short_run_answers_every_line(tmp_path):
    file = tmp_path / "figures" / "latency.json"
    status = main(["--rates", "40", "--seconds", "0.5", "--json", str(file)])
    result = json.loads(file.read_text())
    assert status == (0 if result["to_client"] else 1)  # on a machine that is held up no rate need be carried
    for figures in result["runs_to_client"] + result["runs_to_map"]:
        assert figures["lines"] == 20
        assert sum(figures["lost_lines"].values()) == 0
        assert figures["losses"]["device"]["lines"]["whole"] == 20
        for spread in (figures["latency"], figures["latency_from_due"]):
            assert 0 < spread["p50_s"] <= spread["p99_s"] <= spread["max_s"]
        assert figures["latency_from_due"]["max_s"] >= figures["latency"]["p50_s"]
    through = result["runs_to_client"][0]
    assert through["losses"]["points"]["counted"] == through["points"]
    assert through["losses"]["lines"]["stored"] == 20


def test_a_prepared_scanner_says_what_a_scanner_says_that_measures_when_it_must():
    plan = PassPlan(3, 50.0)
    device, returns = prepare(plan)
    heard, decoder, written, total = [], Decoder(), [], 0
    device.receive(encode(Laser(7, True)) + encode(Start(8, 200_000, 0, 400_000, 50_000)), 10.0)
    for step in range(8):
        now_s = 10.0 + step / 100
        data = device.transmit(now_s, 1 << 20)
        heard += apart(decoder.receive(data))
        total += len(data)
        written.append((now_s, total))
        device.receive(encode(Keepalive(20 + step)), now_s)
    assert isinstance(heard[0], Hello)
    chunks = [item for item in heard if isinstance(item, Chunk)]
    ends = [item.status for item in heard if isinstance(item, EndOfPass)]
    assert [chunk.sequence for chunk in chunks] == list(range(len(chunks)))
    assert [sum(len(c.points) for c in chunks if c.line_index == line) for line in range(3)] == [1280] * 3
    seen = [sum((c.points[:, 0] != -(2**31)).sum() for c in chunks if c.line_index == line) for line in range(3)]
    assert seen == returns.tolist()
    assert [(end.next_sequence, end.next_line, end.dropped_chunks) for end in ends] == [(len(chunks), 3, 0)]
    np.testing.assert_allclose(leaving_times_s(device, written), device.began_s + np.arange(3) / 50.0)


def sent_and_heard():
    sent = Sent(np.array([10, 20, 5]), np.array([1.0, 2.0, 3.0]), np.array([1.5, 2.5, 3.5]), 0.0)
    return sent, Answers(np.array([1.6, 2.7, 2.8, 3.9]), np.array([10.0, 29.0, 30.0, 35.0]), 4, 100, 0.0)


def test_a_line_is_answered_by_the_first_answer_that_covers_its_last_point():
    figures = compare(PassPlan(3, 1.0), *sent_and_heard(), {"on_the_wire": 0})
    assert figures["latency"] == pytest.approx({"p50_s": 0.3, "p99_s": 0.398, "max_s": 0.4})
    assert figures["latency_from_due"]["max_s"] == pytest.approx(0.9)
    assert figures["sent_lines_per_s"] == pytest.approx(1.0)
    assert figures["is_carried"] == (figures["answered_lines_per_s"] >= 0.95)


def test_there_is_no_latency_when_lines_are_lost_or_unanswered():
    sent, answers = sent_and_heard()
    assert compare(PassPlan(3, 1.0), sent, answers, {"on_the_wire": 1})["latency"] is None
    cut = Answers(answers.at_s[:3], answers.points[:3], 3, 100, 0.0)
    unanswered = compare(PassPlan(3, 1.0), sent, cut, {"on_the_wire": 0})
    assert (unanswered["latency"], unanswered["is_carried"]) == (None, False)


def test_lost_lines_are_told_by_where_they_were_lost():
    losses = {
        "device": {"lines": {"whole": 90}},
        "lines": {"stored": 80, "refused": {"too_late": 3, "map_full": 4}},
    }
    assert lost_lines(losses, 100) == {"on_the_wire": 10, "late": 3, "refused": 4, "not_stored": 3}
