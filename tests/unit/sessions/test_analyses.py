"""Analyses run one after the other, tell how far they are, and are bounded in number and in what they keep."""

import threading
import time

import numpy as np
import pytest

from scanner_service.analysis.normals.field import NormalOptions
from scanner_service.sessions import analyses as module
from scanner_service.sessions.analyses import AnalysisBook, AnalysisPoints, AnalysisRequest
from scanner_service.sessions.errors import AnalysesBusy, AnalysisNotDone, AnalysisUnknown

RNG = np.random.default_rng(1)
PLATE = np.column_stack([RNG.uniform(0, 5, (200, 2)), np.zeros(200)])


def request(read=lambda: AnalysisPoints(PLATE, np.array([0.0, 0.0, -9.0])), method="orthogonal_distance"):
    return AnalysisRequest(method, NormalOptions(), {"kind": "test"}, read)


def wait_until_over(book, job_id):
    end = time.monotonic() + 60
    while book.get(job_id).state in ("waiting", "running"):
        assert time.monotonic() < end
        time.sleep(0.01)
    return book.get(job_id)


@pytest.fixture
def book():
    opened = AnalysisBook()
    yield opened
    opened.close()


@pytest.fixture
def held(book):
    """A book whose thread waits in the first analysis until the gate opens."""
    gate, begun = threading.Event(), threading.Event()

    def read():
        begun.set()
        assert gate.wait(60)
        return AnalysisPoints(PLATE, None)

    job = book.begin(request(read))
    assert begun.wait(60)
    yield job, gate
    gate.set()


def test_an_analysis_ends_with_normals_turned_to_where_it_was_seen_from(book):
    job = wait_until_over(book, book.begin(request()).job_id)
    assert (job.state, job.progress, job.points) == ("done", 1.0, 200)
    result = book.result(job.job_id)
    np.testing.assert_array_equal(result.points_mm, PLATE)
    np.testing.assert_allclose(result.answer.normals, np.tile([0.0, 0.0, -1.0], (200, 1)), atol=1e-9)


def test_what_fails_says_why_and_the_next_one_is_served(book):
    failed = wait_until_over(book, book.begin(request(method="voronoi_poles")).job_id)
    assert failed.state == "failed"
    assert "in a plane" in failed.message
    with pytest.raises(AnalysisNotDone, match="in a plane"):
        book.result(failed.job_id)

    def broken():
        raise RuntimeError("secret of the house")

    broken_job = wait_until_over(book, book.begin(request(broken)).job_id)
    assert "secret" not in broken_job.message
    assert wait_until_over(book, book.begin(request()).job_id).state == "done"


def test_an_analysis_that_waits_has_no_result_and_a_limited_number_may_wait(book, held):
    job, _ = held
    assert book.get(job.job_id).state == "running"
    waiting = [book.begin(request()) for _ in range(module.MAX_WAITING)]
    with pytest.raises(AnalysesBusy, match="waiting already"):
        book.begin(request())
    with pytest.raises(AnalysisNotDone, match="waiting"):
        book.result(waiting[0].job_id)
    assert [known.job_id for known in book.jobs()] == [item.job_id for item in [*reversed(waiting), job]]


def test_an_analysis_that_is_not_wanted_ends_and_leaves_nothing(book, held):
    job, gate = held
    book.forget(job.job_id)
    gate.set()
    assert wait_until_over(book, book.begin(request()).job_id).state == "done"
    for ask in (book.get, book.result, book.forget):
        with pytest.raises(AnalysisUnknown):
            ask(job.job_id)


def test_only_the_newest_results_are_kept(book, monkeypatch):
    monkeypatch.setattr(module, "MAX_KEPT", 2)
    jobs = [wait_until_over(book, book.begin(request()).job_id).job_id for _ in range(4)]
    assert {job.job_id for job in book.jobs()} == set(jobs[-2:])


def test_results_are_bounded_by_their_points(book, monkeypatch):
    monkeypatch.setattr(module, "MAX_POINTS", 200)
    jobs = [wait_until_over(book, book.begin(request()).job_id).job_id for _ in range(4)]
    assert len(book.jobs()) == 2
    assert book.get(jobs[-1]).state == "done"
    monkeypatch.setattr(module, "MAX_POINTS", 199)
    assert "at most 199 points" in wait_until_over(book, book.begin(request()).job_id).message
