"""The documentation: the site builds without a warning, and the commands on its pages run."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import child
import pytest
from click.testing import CliRunner

from linkpose.cli import group

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "host" / "docs"
_BLOCK = re.compile(r"^```console\n(.*?)^```", re.MULTILINE | re.DOTALL)

PROGRAMS = "programs.md"  # has steps in Python too

# Commands that need a board with a bootloader, and the test that runs them.
HARDWARE = {
    "linkpose ports": "tests/host/test_cli.py",
    "linkpose flash --prebuilt": "tests/host/test_flash.py",
}


def commands(page: Path) -> list[str]:
    """The commands that a page shows after `$ `, in order."""
    lines = [line for block in _BLOCK.findall(page.read_text(encoding="utf-8")) for line in block.splitlines()]
    return [line[2:].strip() for line in lines if line.startswith("$ ")]


def pages_with_commands() -> list[str]:
    return [page.name for page in sorted(DOCS.glob("*.md")) if commands(page) and page.name != PROGRAMS]


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-f", ROOT / "host/mkdocs.yml", "-d", tmp_path]
    done = subprocess.run(build, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "quickstart" / "index.html").is_file()
    assert "COBS" in (tmp_path / "protocol" / "index.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", pages_with_commands())
def test_the_commands_of_a_page_run(name: str, tmp_path: Path) -> None:
    """In one folder, in the order of the page. A simulated link, ten times as fast, stands in for the board."""
    for command in commands(DOCS / name):
        if command in HARDWARE:
            assert (ROOT / HARDWARE[command]).is_file()
            continue
        program, *words = shlex.split(command)
        assert program == "linkpose", f"{name}: a console block shows linkpose commands only, not {command!r}"
        words = [re.sub(r"^sim://\w+$", r"\g<0>?speed=10", word) for word in words]
        done = child.run(tmp_path, words, environment={"LINKPOSE_PORT": "sim://link?seed=1&speed=10"})
        assert done.status == 0, f"{name}: {command}\n{done.err}"


def test_the_steps_to_other_programs_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands and Python of the page, in its order; in one process, which imports the libraries once."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LINKPOSE_PORT", "sim://link?seed=1&speed=10")
    text = (DOCS / PROGRAMS).read_text(encoding="utf-8")
    steps = re.findall(r"^( *)```(console|python)\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL)
    assert {language for _, language, _ in steps} == {"console", "python"}
    for indent, language, body in steps:
        if language == "python":
            exec(compile(textwrap.dedent(body), PROGRAMS, "exec"), {})
            continue
        for line in body.splitlines():
            program, *arguments = shlex.split(line.removeprefix(f"{indent}$ "))
            done = CliRunner().invoke(group, arguments)
            assert program == "linkpose" and done.exit_code == 0, f"{line}\n{done.output}"


def test_every_cited_key_is_in_the_references() -> None:
    known = set(re.findall(r"\*\*\[(\w[\w-]*)\]\*\*", (DOCS / "references.md").read_text(encoding="utf-8")))
    sources = [*DOCS.glob("*.md"), *(ROOT / "host" / "linkpose").rglob("*.py")]
    papers = re.compile(r"\[(Link|Thesis|Mice|[A-Z][a-z]+\d{4})\](?!\()")
    cited = {key for source in sources for key in papers.findall(source.read_text(encoding="utf-8"))}
    assert cited <= known
    assert {"Link", "Thesis", "Mice"} <= known


def messages_of_the_program() -> list[str]:
    """Every text in the sources, with … for what is filled in."""
    texts = []
    for path in (ROOT / "host/linkpose").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                texts.append(
                    "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values)
                )
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return texts


def test_every_message_in_the_troubleshooting_page_is_the_program_s():
    """The first cells of the tables of messages quote them; numbers and names are filled in."""
    rows = re.findall(r"^\| (`.*?) \|", (ROOT / "host/docs/troubleshooting.md").read_text(), re.MULTILINE)
    texts = "\n".join(messages_of_the_program())
    quoted = [quote for row in rows for quote in re.findall(r"`([^`]+)`", row)]
    pieces = [
        piece.strip() for quote in quoted for piece in re.split(r"…|\d[\d.]*( V| s\b)?|\(.*?\)|;", quote) if piece
    ]
    missing = [piece for piece in pieces if " " in piece and piece not in texts]
    assert len(pieces) > 30
    assert not missing
