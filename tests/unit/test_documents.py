"""The documents are true to the code, and speak of the project alone."""

import re
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest
import typer.main
from fastapi import FastAPI

from drivers.rig_file import parse_rig
from drivers.stages.known import KNOWN as STAGES
from drivers.stages.known import open_stage
from scanner_service.api.login import login_router
from scanner_service.api.routes import analyses, exports, files, health, live, passes, results, scanlines, sessions
from scanner_service.api.scopes import route_table
from scanner_service.cli import app
from scanner_service.sessions.settings import SessionSettings

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(DOCS.rglob("*.md"))]
GROUP = typer.main.get_command(app)
COMMANDS = {name: GROUP.get_command(None, name) for name in GROUP.list_commands(None)}
CODE = ("scanner_service", "drivers", "simulators")


def text_of(page):
    return page.read_text(encoding="utf-8")


def links_of(page):
    return re.findall(r"\]\(([^)\s]+)\)", text_of(page))


def anchors_of(page):
    """The anchors that a forge makes of headings."""
    headings = re.findall(r"^#+ (.*)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere_inside_the_project(page):
    for link in links_of(page):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.is_relative_to(ROOT), link
        assert target.exists(), link
        assert not anchor or anchor in anchors_of(target), link


def test_every_document_can_be_reached_from_the_index():
    reached = {(DOCS / link.partition("#")[0]).resolve() for link in links_of(DOCS / "index.md")}
    assert {page for page in PAGES if page.is_relative_to(DOCS)} - reached == {DOCS / "index.md"}
    assert "docs/index.md" in links_of(ROOT / "README.md")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_that_a_document_names_exists(page):
    for name, rest in re.findall(r"(?:`|^\s*\$? ?)scanner ([a-z]\w*)([^`\n]*)", text_of(page), re.MULTILINE):
        assert name in COMMANDS, name
        command, words = COMMANDS[name], rest.split()
        if "commands" in vars(command) and words:
            command = command.commands[words[0]]
        known = {option for parameter in command.params for option in parameter.opts}
        assert set(re.findall(r"(?<= )--[a-z][a-z-]*", rest)) <= known, rest


def test_the_readme_names_every_command():
    assert set(re.findall(r"`scanner ([a-z]\w*)", text_of(ROOT / "README.md"))) | {"demo"} == set(COMMANDS)


def test_every_make_target_that_the_readme_names_exists():
    targets = set(re.findall(r"^([a-z-]+):", text_of(ROOT / "Makefile"), re.MULTILINE))
    named = set(re.findall(r"`make ([a-z][a-z-]*)", text_of(ROOT / "README.md")))
    assert {"demo", "test"} <= named <= targets


def test_the_readme_fits_one_screen():
    assert len(text_of(ROOT / "README.md").splitlines()) <= 50
    assert (DOCS / "images" / "demo.png").stat().st_size < 400_000


def test_every_setting_of_a_session_is_documented_with_its_default():
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+?) \|", text_of(DOCS / "method.md").split("## 10.")[1], re.MULTILINE))
    for field in fields(SessionSettings):
        said, default = rows.pop(field.name).strip("`").replace(",", ""), field.default
        if field.name.endswith("_rad"):
            assert said == "5°"
            assert default == pytest.approx(0.0872664626)
        elif field.name == "target":
            assert said == "nothing more"
        else:
            assert said == ("none" if default is None else str(default)), field.name
    assert rows == {}


def test_every_address_is_documented_with_its_role():
    service = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    service.include_router(login_router())
    for module in (health, sessions, scanlines, results, passes, exports, live, analyses, files):
        service.include_router(module.router)
    declared = {
        (method, route.path, route.role.name.lower() if route.role else "public")
        for route in route_table(service)
        for method in (route.methods or {"WS"})
    }
    written = set(re.findall(r"^\| ([A-Z]+) \| `([^`]+)` \| (\w+) \|", text_of(DOCS / "api.md"), re.MULTILINE))
    assert declared - written == {("GET", "/login", "public")}  # for people, told in docs/security.md
    assert written <= declared


def test_every_package_has_its_place_in_the_picture_of_the_house():
    picture = text_of(DOCS / "architecture.md")
    for top in CODE:
        for found in (ROOT / top).rglob("__init__.py"):
            name = found.parent.relative_to(ROOT).as_posix()
            assert f"`{name}/" in picture or name == "drivers", name


def test_every_import_contract_is_in_the_picture_of_the_house():
    contracts = tomllib.loads(text_of(ROOT / "pyproject.toml"))["tool"]["importlinter"]["contracts"]
    for contract in contracts:
        assert f"| {contract['name']} |" in text_of(DOCS / "architecture.md")


def test_no_file_tells_of_the_place_where_it_was_written():
    place = re.compile("/" + r"(?:work|root|tmp|home/\w+)/" + r"|\bissue" + r" #?\d", re.IGNORECASE)
    files = [*PAGES, ROOT / "Makefile", ROOT / "pyproject.toml"]
    for folder in (*CODE, "tests", "benchmarks"):
        files += [path for kind in ("py", "js", "mjs", "html", "css") for path in (ROOT / folder).rglob(f"*.{kind}")]
    for path in files:
        if "vendor" not in path.parts:
            found = place.search(text_of(path))
            assert found is None, f"{path.relative_to(ROOT)}: {found[0]}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_page_holds_a_place_that_somebody_meant_to_fill_in(page):
    found = re.search(r"@[A-Za-z_][\w .-]*@|\{\{.*?\}\}|\bTODO\b|\bFIXME\b|\bXXX\b|\bTBD\b", text_of(page))
    assert found is None, f"{page.name}: {found[0]}"


def test_every_example_of_a_rig_file_is_one_and_its_stage_can_be_opened():
    examples = [
        (page.name, block)
        for page in sorted((DOCS / "devices").glob("*.md"))
        for block in re.findall(r"^```toml\n(.*?)^```", text_of(page), re.MULTILINE | re.DOTALL)
    ]
    kinds = set()
    for name, block in examples:
        described = parse_rig(block, name)
        open_stage(described)
        kinds.add(described.stage.kind)
    assert kinds == set(STAGES)


def test_every_option_of_a_stage_is_documented_with_its_default():
    pages = {"constant_speed": "unmoved.md", "encoder": "unmoved.md"}
    for kind, known in STAGES.items():
        text = text_of(DOCS / "devices" / pages.get(kind, f"{kind}.md"))
        for option, spec in known.options.items():
            row = re.search(rf"^\|[^|]*`{option}`[^|]*\| ([^|]+) \|", text, re.MULTILINE)
            assert row is not None, f"{kind}: {option}"
            said = row[1].strip("` ")
            assert (
                str(spec.default).lower().removesuffix(".0") in said.lower().replace(",", "") or "must be given" in said
            )


def test_all_fifteen_troubles_are_answered():
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \| ([^|]+) \|$", text_of(DOCS / "devices" / "index.md"), re.MULTILINE)
    assert [int(row[0]) for row in rows] == list(range(1, 16))
    assert all(len(row[2]) > 40 for row in rows)
