"""Laws of problem details, asked over real connections."""

import json
import logging
import re
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from hypothesis import given
from hypothesis import strategies as st

from scanner_service.api.access import ACCESS_PROBLEMS
from scanner_service.api.app import SESSION_PROBLEMS
from scanner_service.api.explanations import EXPLANATIONS, explanation_of
from scanner_service.api.guard import GUARD_PROBLEMS
from scanner_service.api.keys import Role
from scanner_service.api.problems import (
    STANDARD_PROBLEMS,
    Problem,
    problem_document,
    problem_of_status,
    register_problems,
)
from tests.unit.api.small_service import StageBlocked, client, served, small_app

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def http(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    app = small_app(tmp_path_factory.mktemp("data"))
    key = app.state.access.create_key(Role.OPERATOR, "x")
    with served(app) as listening, client(listening, key) as http:
        yield http


def test_an_error_of_the_table_is_told_with_its_status_title_and_message(http: httpx.Client) -> None:
    response = http.get("/api/v1/blocked")
    assert response.headers["content-type"] == "application/problem+json"
    assert response.json() == {
        "type": "/problems/stage-blocked",
        "title": "The stage is blocked",
        "status": 409,
        "detail": "The stage stands against its end switch; move it back by hand.",
    }
    assert response.status_code == 409


def test_the_type_of_every_problem_can_be_looked_up(http: httpx.Client) -> None:
    asked = [http.get(path) for path in ["/api/v1/blocked", "/api/v1/broken", "/nowhere", "/a\\b", "/login?token=x"]]
    asked.append(http.post("/api/v1/lines", json={}))
    for document in [response.json() for response in asked]:
        told = http.get(document["type"]).json()
        assert {name: told.pop(name) for name in ["type", "title", "status"]}.items() <= document.items()
        assert set(told) == {"happened", "remedy", "read"}
    assert http.get("/problems/no-such").status_code == 404


def test_every_kind_of_problem_says_what_happened_what_to_do_and_where_to_read_on() -> None:
    known = [*SESSION_PROBLEMS.values(), *ACCESS_PROBLEMS.values(), *GUARD_PROBLEMS, *STANDARD_PROBLEMS]
    assert {problem.slug for problem in known} == set(EXPLANATIONS)
    anchors: dict[str, set[str]] = {}
    for slug, told in [*EXPLANATIONS.items(), ("not-found", explanation_of("not-found", 404))]:
        page, _, anchor = told.read.partition("#")
        if page not in anchors:
            heads = re.findall(r"^#+ (.*)$", (ROOT / page).read_text(), re.MULTILINE)
            anchors[page] = {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}
        assert not anchor or anchor in anchors[page], (slug, told.read)
        assert all(text.endswith((".", ")")) and text.count("`") % 2 == 0 for text in told[:2]), slug


def test_a_person_who_follows_the_address_of_a_problem_gets_a_page(http: httpx.Client) -> None:
    page = http.get("/problems/internal-error", headers={"Accept": "text/html,*/*;q=0.8"})
    assert page.headers["content-type"].startswith("text/html")
    assert EXPLANATIONS["internal-error"].remedy in page.text
    assert "script-src 'self'" in page.headers["content-security-policy"]


def test_an_unknown_error_tells_nothing_of_the_inside_and_is_logged(
    http: httpx.Client, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.ERROR):
        response = http.get("/api/v1/broken")
    assert response.status_code == 500
    assert response.json()["type"] == "/problems/internal-error"
    assert "secret" not in response.text
    assert "RuntimeError" not in response.text
    assert any("GET /api/v1/broken failed: RuntimeError" in record.getMessage() for record in caplog.records)
    while "secret of the house" not in caplog.text:  # the server logs the trace after it has answered
        time.sleep(0.01)
    assert caplog.text.count("Traceback") == 1


@pytest.mark.parametrize(("method", "path", "status"), [("GET", "/nowhere", 404), ("PUT", "/api/v1/lines", 405)])
def test_what_the_framework_refuses_is_a_problem_too(http: httpx.Client, method: str, path: str, status: int) -> None:
    response = http.request(method, path)
    assert (response.status_code, response.json()["status"]) == (status, status)
    assert response.headers["content-type"] == "application/problem+json"


def test_a_validation_error_names_the_place_and_never_the_value(http: httpx.Client) -> None:
    response = http.post("/api/v1/lines", json={"line_spacing_mm": "secret", "points": [1.0, "secret"]})
    document = response.json()
    assert response.status_code == 422
    assert [error["at"] for error in document["errors"]] == ["body.line_spacing_mm", "body.points.1"]
    assert document["error_count"] == 2
    assert document["detail"].startswith("body.line_spacing_mm must be a valid number")
    assert document["detail"].endswith("; 1 more thing is wrong with the request")
    assert "secret" not in response.text


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ({}, "body.line_spacing_mm is missing"),
        ({"line_spacing_mm": True, "points": 3}, "body.points must be a valid list"),
        ({"line_spacing_mm": 1, "colour": 2}, "body.colour is not known here: leave it out"),
    ],
)
def test_a_validation_error_is_one_sentence(http: httpx.Client, body: object, said: str) -> None:
    assert http.post("/api/v1/lines", json=body).json()["detail"] == said


@pytest.mark.parametrize(
    "body", [{"line_spacing_mm": "nan"}, {"line_spacing_mm": "-inf"}, {"line_spacing_mm": 1, "points": ["x"] * 5000}]
)
def test_no_value_makes_the_answer_unwritable_or_long(http: httpx.Client, body: object) -> None:
    response = http.post("/api/v1/lines", json=body)
    assert response.status_code == 422
    assert len(response.content) < 10_000


@pytest.mark.parametrize("name", ["\\ud800", "\\u0000", "x" * 100_000, "é"])
def test_no_field_name_makes_the_answer_unwritable_or_long(http: httpx.Client, name: str) -> None:
    body = b'{"line_spacing_mm": 1, "' + name.encode() + b'": 2}'
    response = http.post("/api/v1/lines", content=body, headers={"Content-Type": "application/json"})
    assert response.status_code == 422
    assert len(response.content) < 10_000


def test_a_number_of_too_many_digits_is_a_client_error(http: httpx.Client) -> None:
    for digits in [300, 308, 5000]:
        body = b'{"line_spacing_mm": "' + b"9" * digits + b'"}'
        response = http.post("/api/v1/lines", content=body, headers={"Content-Type": "application/json"})
        assert response.status_code in {200, 400, 422}


@given(st.text(), st.dictionaries(st.text(), st.one_of(st.text(), st.integers(), st.none())))
def test_any_text_can_be_told(detail: str, members: dict[str, object]) -> None:
    document = json.loads(problem_document(Problem(400, "x", "X"), detail, members))
    assert {**document, **members} == document
    if "detail" not in members:
        assert document["detail"][:200] == detail[:200]


def test_a_number_that_is_not_finite_is_never_written() -> None:
    with pytest.raises(ValueError, match="JSON"):
        problem_document(Problem(400, "x", "X"), "x", {"value": float("nan")})


def test_one_slug_cannot_stand_for_two_problems() -> None:
    class Other(StageBlocked):
        pass

    table = {StageBlocked: Problem(409, "blocked", "Blocked"), Other: Problem(503, "blocked", "Blocked")}
    with pytest.raises(ValueError, match="blocked"):
        register_problems(FastAPI(), table)


def test_a_bare_status_has_a_slug() -> None:
    assert problem_of_status(404).slug == "not-found"
    assert problem_of_status(418).slug == "im-a-teapot"
    assert problem_of_status(599).status == 599


def test_the_docs_page_needs_no_network_and_no_inline_script(http: httpx.Client, tmp_path: Path) -> None:
    page = http.get("/docs")
    assert "script-src 'self';" in page.headers["content-security-policy"]
    assert "://" not in page.text
    for asset in ["/docs/start.js", "/docs/assets/swagger-ui.css", "/docs/assets/swagger-ui-bundle.js"]:
        assert asset in page.text
        assert http.get(asset).status_code == 200
    assert "/api/v1/lines" in http.get("/openapi.json").json()["paths"]
