"""The page's files: what they may load, what they are, and the laws of the parts that need no browser."""

import base64
import hashlib
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from scanner_service.web import CONTENT_SECURITY_POLICY, IMPORT_MAP_SHA256, INDEX_HTML, STATIC_DIR

VENDOR = STATIC_DIR / "vendor" / "three"
NODE = shutil.which("node")


def test_the_policy_names_the_hash_of_the_page_s_import_map_and_nothing_unsafe() -> None:
    found = re.findall(r'<script type="importmap">(.*?)</script>', INDEX_HTML.read_text(encoding="utf-8"), re.DOTALL)
    assert len(found) == 1
    digest = base64.b64encode(hashlib.sha256(found[0].encode()).digest()).decode()
    assert f"sha256-{digest}" == IMPORT_MAP_SHA256
    assert IMPORT_MAP_SHA256 in CONTENT_SECURITY_POLICY
    assert "unsafe" not in CONTENT_SECURITY_POLICY


def test_the_page_has_no_other_inline_script_or_style() -> None:
    html = INDEX_HTML.read_text(encoding="utf-8")
    assert re.findall(r"<style|\sstyle=|\son[a-z]+=", html) == []
    scripts = re.findall(r"<script([^>]*)>(.*?)</script>", html, re.DOTALL)
    assert [body for attributes, body in scripts if "importmap" not in attributes] == [""]


def test_every_file_the_page_refers_to_is_in_the_package() -> None:
    html = INDEX_HTML.read_text(encoding="utf-8")
    named = re.findall(r'(?:href|src)="(?!#)([^"]+)"', html) + re.findall(r'"three":"\./([^"]+)"', html)
    assert {name for name in named if not name.startswith("static/")} == set()
    assert [name for name in named if not (STATIC_DIR.parent / name).is_file()] == []
    for script in STATIC_DIR.glob("*.js"):
        for name in re.findall(r'from "(\./[^"]+)"', script.read_text(encoding="utf-8")):
            assert (script.parent / name).is_file(), f"{script.name} imports {name}"


def test_the_page_s_own_files_name_no_other_host() -> None:
    own = [path for path in STATIC_DIR.iterdir() if path.suffix in {".js", ".css", ".html"}]
    hosts = [(path.name, url) for path in own for url in re.findall(r"https?://[^\s\"')]+", path.read_text("utf-8"))]
    assert [found for found in hosts if found[1] != "http://www.w3.org/2000/svg"] == []


def test_the_vendored_library_is_unmodified() -> None:
    listed = dict(
        reversed(line.split("  "))
        for line in (VENDOR / "VERSION").read_text().splitlines()
        if re.match(r"[0-9a-f]{64}  ", line)
    )
    present = {str(path.relative_to(VENDOR)) for path in VENDOR.rglob("*") if path.is_file() and path.name != "VERSION"}
    assert set(listed) == present
    assert [name for name in listed if hashlib.sha256((VENDOR / name).read_bytes()).hexdigest() != listed[name]] == []


@pytest.mark.skipif(NODE is None, reason="node is not installed")
def test_decoding_storing_picking_colours_and_reconnection_in_node() -> None:
    files = sorted(str(path) for path in Path(__file__).parent.glob("*.test.mjs"))
    assert files
    ran = subprocess.run([str(NODE), "--test", *files], capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert int(re.findall(r"pass (\d+)", ran.stdout)[-1]) >= 10, "hardly a test ran"


def test_no_file_of_the_page_is_kept_out_of_the_package_by_an_ignore_rule() -> None:
    root = STATIC_DIR.parents[2]
    git = shutil.which("git")
    if git is None or not (root / ".git").exists():
        pytest.skip("not a git checkout")
    files = [str(path) for path in STATIC_DIR.rglob("*") if path.is_file()]
    ran = subprocess.run(
        [git, "-C", str(root), "check-ignore", "--no-index", *files], capture_output=True, text=True, check=False
    )
    assert ran.stdout == ""
