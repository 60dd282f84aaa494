"""The course of a session: what a source says moves it while lines may come, and never after."""

import pytest

from scanner_service.sessions.course import Course
from scanner_service.sessions.errors import SessionBusy


@pytest.fixture
def written():
    return []


@pytest.fixture
def course(written):
    """A session that scans."""
    course = Course("created", lambda: 0.0, written.append)
    with course.setting_out():
        pass
    return course


SAID = [
    lambda course: course.wait_for_return("the scanner is gone"),
    lambda course: course.hold("resume it"),
    lambda course: course.go_on(),
]


@pytest.mark.parametrize("says", SAID)
@pytest.mark.parametrize("ends", [lambda course: None, lambda course: course.end("stopped", None)])
def test_what_a_source_says_late_changes_nothing_of_an_end(course, written, says, ends):
    assert course.begin_to_end()
    ends(course)
    before = course.state, course.is_held, course.message, list(written)
    says(course)
    assert (course.state, course.is_held, course.message, written) == before


def test_a_pause_is_over_at_once(course, written):
    with course.holding("paused"):
        pass
    assert (course.state, course.is_held) == ("paused", True)
    course.go_on()  # a line that was still on its way
    assert course.state == "paused"
    course.release()
    assert (course.state, course.is_held, course.message) == ("scanning", False, None)
    assert written == ["scanning", "paused", "scanning"]


def test_one_ends_it_and_no_line_is_taken_from_then_on(course):
    with course.line_handed_over():
        assert course.begin_to_end() and not course.begin_to_end()
    with pytest.raises(SessionBusy, match="being stopped"), course.line_handed_over():
        pass
    course.fail_to_end()
    assert course.begin_to_end()
    course.end("failed", "why")
    assert not course.begin_to_end()
    assert (course.state, course.message, course.has_ended) == ("failed", "why", True)
