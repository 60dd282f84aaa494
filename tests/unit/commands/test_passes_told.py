"""What `scanner rescan` says of a pass and of what became of it: areas that were foretold, with their intervals."""

import pytest

from scanner_service.commands.rescan import _tell_plan, fate_of

OUTCOME = {
    "promised_mm2": 12.2, "promised_between_mm2": [8.0, 15.4], "reached_mm2": 9.0,
    "expected_mm2": 30.0, "expected_between_mm2": [0.0, 81.0], "found_mm2": 55.0, "doubt": None,
}  # fmt: skip
ORDER = {"status": "done", "message": None, "reached_end": True, "outcome": OUTCOME}


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({}, "done; promised 12 mm² (8 to 15), reached 9 mm²; explored: 55 mm² found, 30 mm² (0 to 81) expected"),
        ({"expected_mm2": 0.2}, "done; promised 12 mm² (8 to 15), reached 9 mm²"),
        ({"promised_mm2": 0.0}, "done; explored: 55 mm² found, 30 mm² (0 to 81) expected"),
        ({"promised_between_mm2": None, "expected_mm2": 0.0}, "done; promised 12 mm², reached 9 mm²"),  # older records
        ({"promised_mm2": 0.0, "expected_mm2": 0.0}, "done; promised 0 mm² (8 to 15), reached 9 mm²"),
    ],
)
def test_an_order_says_what_came_of_what_was_foretold(changed, told):
    assert fate_of(ORDER | {"outcome": OUTCOME | changed}) == told


@pytest.mark.parametrize("status", ["doubted", "withdrawn"])
def test_an_order_whose_points_do_not_count_has_reached_nothing(status):
    told = fate_of(ORDER | {"status": status, "order": 7, "outcome": OUTCOME | {"doubt": "was the part moved?"}})
    assert told.startswith(status) and "reached" not in told and "found" not in told
    assert ("was the part moved? If so, `scanner rescan SESSION --withdraw 7`" in told) == (status == "doubted")


@pytest.mark.parametrize(
    ("promised_mm2", "explores_mm2", "told"),
    [
        (12.2, 30.0, "promises 12 mm² (8 to 15), explores, and expects 30 mm² (0 to 81)"),
        (12.2, 0.1, "promises 12 mm² (8 to 15)"),
        (0.1, 30.0, "explores, and expects 30 mm² (0 to 81)"),
    ],
)
def test_a_plan_says_what_each_pass_promises_and_explores(capsys, promised_mm2, explores_mm2, told):
    one = {
        "number": 1, "start_mm": 0.0, "end_mm": 9.0, "line_spacing_mm": 0.2, "lines": 46, "duration_s": 1.0,
        "approach_s": 1.0, "gain_mm2": 42.0, "gain_per_s_mm2": 21.0, "turn_part": None, "serves": [{"region": 3}],
        "promised_mm2": promised_mm2, "promised_between_mm2": [8.0, 15.4],
        "explores_mm2": explores_mm2, "explores_between_mm2": [0.0, 81.0],
    }  # fmt: skip
    _tell_plan({"plan": 4, "passes": [one], "unreachable": []})
    assert f"pass 1 serves region 3: {told}\n" in capsys.readouterr().out
