"""The guides are true: what they tell a reader to type is run, on small simulated benches, in a folder of its own.

In README.md and the guides next to the code:

- ```console: lines that begin with "$ " are run; the lines after each are compared with what it printed, with every
  number masked, and "..." standing for anything. ```sh: the same, without "$ " and without output.
- ```python is run; a ```text right after it is what it prints.
- ```toml must be TOML; one whose first line is "# NAME.toml" becomes that file.
- <!-- not run: REASON --> before a block: its commands and options must exist, its Python must compile.
- <!-- run on a small bench: REASON --> before a block, or <!-- printed on a small bench: REASON --> before a ```text:
  run, but the output is not compared.

`virtual:demo` and `virtual:convention` are small benches here, and the catalogue has only the effects that the guide's
blocks name, so that all of it takes half a minute of one core. The blocks of a guide run in one folder, in their order.
What the README makes (captures/, model.toml, bundle/) is there for the other guides.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from runtime.cli import main as runtime_main
from tests.trainer.hidden import with_few_effects
from trainer.captures.bench_file import read_bench
from trainer.cli import main as trainer_main

ROOT = Path(__file__).resolve().parent.parent
FIRST = ("README.md", "trainer/README.md", "trainer/captures/README.md", "trainer/effects/README.md")
GUIDES = [
    *FIRST,
    *sorted(
        name
        for path in ROOT.rglob("*.md")
        if (name := path.relative_to(ROOT).as_posix()) not in FIRST
        and name.split("/")[0] in (path.name, "trainer", "runtime", "firmware_iface")
    ),
]
# what a block must keep time for
IN_REAL_TIME = ("--emulated", "open_guarded_lasers", "hololoop-runtime serve")
PROGRAMS = {"hololoop-trainer": trainer_main, "hololoop-runtime": runtime_main}
SMALL = """
name = "{name}"
[panel]
width = 96
height = 64
pitch_um = 8.0
[propagation]
distance_mm = 8
[[defect]]
{defect}
"""
STAND_INS = {
    "virtual:demo": SMALL.format(name="demo", defect='kind = "phase_response"'),
    "virtual:convention": SMALL.format(name="convention", defect='kind = "convention"\nphase_sign = -1'),
}
NOT_RUN, SMALL_BENCH = (
    re.compile(r"<!-- not run: \S.*-->"),
    re.compile(r"<!-- (run|printed) on a small bench"),
)
NUMBER = re.compile(r"[-−+]?\d+(?:[.,]\d+)*(?:e[-+]?\d+)?(?: × 10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)?")


@dataclass(frozen=True)
class Block:
    """A fenced block of a guide: its language, its text, and the comment in front of it."""

    guide: str
    line: int
    language: str
    text: str
    comment: str

    @property
    def where(self) -> str:
        return f"{self.guide}:{self.line}"


@dataclass(frozen=True)
class Typed:
    """A line that a reader types, and what a guide shows below it."""

    line: str
    shown: tuple[str, ...]


@cache
def blocks_of(guide: str) -> tuple[Block, ...]:
    """The fenced blocks of a guide, in order."""
    found: list[Block] = []
    comment, language, first, inside = "", "", 0, None
    for number, line in enumerate((ROOT / guide).read_text(encoding="utf-8").splitlines(), 1):
        if inside is None and line.startswith("```"):
            language, first, inside = line[3:].strip(), number, []
        elif inside is None:
            comment = line if line.startswith("<!--") else comment if not line else ""
        elif line == "```":
            found.append(Block(guide, first, language, "\n".join(inside) + "\n", comment))
            comment, inside = "", None
        else:
            inside.append(line)
    assert inside is None, f"{guide}:{first}: a block without an end"
    return tuple(found)


def typed_in(block: Block) -> Iterator[Typed]:
    """The command lines of a console or sh block; a backslash joins lines."""
    lines = block.text.replace("\\\n", " ").splitlines()
    if block.language == "sh":
        yield from (Typed(line, ()) for line in lines if line.strip() and not line.startswith("#"))
        return
    starts = [k for k, line in enumerate(lines) if line.startswith("$ ")]
    assert starts and starts[0] == 0, f"{block.where}: a console block begins with '$ '"
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        yield Typed(lines[start][2:], tuple(lines[start + 1 : end]))


def words_of(line: str) -> list[str]:
    return shlex.split(line, comments=True)


def masked(text: str) -> str:
    """Text on one line with every number replaced."""
    return NUMBER.sub("#", " ".join(text.split()))


def check_shown(where: str, shown: tuple[str, ...], printed: str) -> None:
    actual = masked(printed)
    for line in shown:
        for part in line.split("..."):
            expected = masked(part).strip("(); ")
            assert expected in actual, f"{where} shows {line!r}, and what was printed is:\n{printed}"


def run_program(words: list[str]) -> tuple[int, str]:
    """Exit code and standard output of hololoop-trainer, hololoop-runtime or pytest."""
    if words[0] == "pytest":
        done = subprocess.run(
            [sys.executable, "-m", *words, "-q", "-p", "no:cacheprovider", "-p", "no:xdist"],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        return done.returncode, done.stdout
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = PROGRAMS[words[0]](words[1:])
    return code, out.getvalue() + (err.getvalue() if code else "")


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which a reader follows a guide, with a picture; the current one during the test."""
    y, x = np.mgrid[:80, :120]
    disc = (40 + 200 * ((y - 40) ** 2 + (x - 60) ** 2 < 700)).astype(np.uint8)
    Image.fromarray(disc).save(tmp_path / "picture.png")
    for name, text in STAND_INS.items():
        (tmp_path / f"small_{name.split(':')[1]}.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_block(block: Block, following: Block | None) -> None:
    """Run a block in the current folder and compare what it prints."""
    if block.language in ("console", "sh"):
        for one in typed_in(block):
            words = words_of(one.line)
            if words[0] == "make":  # the Makefile's own test
                assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE), block.where
                continue
            stood_in = [f"small_{w.split(':')[1]}.toml" if w in STAND_INS else w for w in words]
            code, printed = run_program(stood_in)
            finds_errors = words[1:2] == ["check"] and any(" error" in line for line in one.shown)
            assert code == (1 if finds_errors else 0), (
                f"{block.where}: {one.line} ended with {code}:\n{printed}"
            )
            if not SMALL_BENCH.match(block.comment):
                check_shown(block.where, one.shown, printed)
    elif block.language == "python":
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compile(block.text, block.where, "exec"), {"__name__": "__guide__"})
        if following is not None and following.language == "text":
            if SMALL_BENCH.match(following.comment):
                assert out.getvalue().strip(), block.where
            else:
                check_shown(block.where, tuple(following.text.splitlines()), out.getvalue())


def keep_toml(block: Block, folder: Path) -> None:
    """A toml block must be TOML; a bench file must be one that is read."""
    tomllib.loads(block.text)
    name = re.match(r"# ([\w.]+\.toml)\n", block.text)
    if name:
        path = folder / name[1]
        path.write_text(block.text, encoding="utf-8")
        if name[1] == "bench.toml":
            read_bench(path)


@pytest.mark.parametrize("guide", GUIDES)
def test_what_a_guide_shows_works(
    guide: str, workspace: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    blocks = blocks_of(guide)
    named = {word for block in blocks for word in re.findall(r"\w+", block.text)}
    with_few_effects(monkeypatch, "phase_response", *named)
    run = [b for b in blocks if b.language in ("console", "sh", "python") and not NOT_RUN.match(b.comment)]
    if any(word in b.text for b in run for word in IN_REAL_TIME):
        request.getfixturevalue("real_time")
    if guide != "README.md" and any("captures/" in b.text or "bundle/" in b.text for b in run):
        make_what_the_readme_makes()
    for k, block in enumerate(blocks):
        if block.language == "toml":
            keep_toml(block, workspace)
        elif block in run:
            run_block(block, blocks[k + 1] if k + 1 < len(blocks) else None)


def make_what_the_readme_makes() -> None:
    """captures/, model.toml and bundle/, so that each guide can be tested by itself."""
    for line in (
        "hololoop-trainer capture --bench small_demo.toml --patterns 8 --out captures",
        "hololoop-trainer add phase_response captures --out model.toml",
        "hololoop-trainer export --model model.toml --captures captures --out bundle",
    ):
        code, printed = run_program(words_of(line))
        assert code == 0, printed


@cache
def help_of(program: str, command: str) -> str:
    code, text = run_program([program, command, "--help"])
    assert code == 0, f"{program} {command}: {text}"
    return text


@pytest.mark.parametrize("guide", GUIDES)
def test_commands_that_are_not_run_exist_with_their_options(guide: str) -> None:
    """Also those that stand in a sentence or a table, in backquotes."""
    typed = [one.line for b in blocks_of(guide) if b.language in ("console", "sh") for one in typed_in(b)]
    prose = re.sub(r"```.*?```", "", (ROOT / guide).read_text(encoding="utf-8"), flags=re.DOTALL)
    typed += [" ".join(m.split()) for m in re.findall(r"`(hololoop-(?:trainer|runtime) [a-z][^`]*)`", prose)]
    for line in typed:
        words = words_of(line)
        if words[0] not in PROGRAMS or len(words) < 2:
            continue
        text = help_of(words[0], words[1])
        for word in words[2:]:
            option = word.split("=")[0]
            if option.startswith("--"):
                assert re.search(rf"{option}\b", text), f"{guide}: {line}: there is no option {option}"


@pytest.mark.parametrize("guide", GUIDES)
def test_python_that_is_not_run_compiles(guide: str) -> None:
    for block in blocks_of(guide):
        if block.language == "python":
            compile(block.text, block.where, "exec")


@pytest.mark.parametrize("guide", GUIDES)
def test_no_command_hides_from_these_tests(guide: str) -> None:
    """Every block says its language, and no command stands in an indented block."""
    for block in blocks_of(guide):
        assert block.language in ("console", "sh", "python", "toml", "text", "c", "json"), block.where
    outside = re.sub(r"```.*?```", "", (ROOT / guide).read_text(encoding="utf-8"), flags=re.DOTALL)
    assert not re.findall(r"^    .*(?:hololoop-(?:trainer|runtime)|^    \$ ).*$", outside, re.MULTILINE)


def anchors_of(path: Path) -> set[str]:
    """What headings can be linked to by, as GitHub makes it."""
    heads = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("guide", GUIDES)
def test_links_lead_somewhere(guide: str) -> None:
    text = (ROOT / guide).read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        path = ((ROOT / guide).parent / name).resolve() if name else ROOT / guide
        assert path.exists(), f"{guide}: {link}"
        assert not anchor or anchor in anchors_of(path), f"{guide}: {link}"


def test_the_readme_is_short_and_leads_to_every_guide() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 160
    for word in ("spatial light modulator", "SLM", "phase hologram", "phase retrieval", "camera in the loop"):
        assert word in " ".join(text.split("##")[0].replace("*", "").split()), word
    linked = {link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text)}
    guides = {name for name in GUIDES if name.endswith("README.md")} - {"README.md"}
    assert guides <= linked


def test_make_quick_names_tests_that_exist() -> None:
    named = re.findall(r"tests/\S+\.py", (ROOT / "Makefile").read_text(encoding="utf-8"))
    assert len(named) > 10
    assert [name for name in named if not (ROOT / name).is_file()] == []


def test_the_table_of_effects_is_the_catalogue() -> None:
    from trainer.effects.effect_catalogue import BUILT_IN

    text = (ROOT / "trainer/effects/README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\w+) \|.*\| (\w+) \|$", text, re.MULTILINE)
    assert [(name, stage) for name, stage, _ in rows] == [(e.name, e.stage) for e in BUILT_IN]
    audiences = [e.acts_on for e in BUILT_IN]
    assert [audience for *_, audience in rows] == audiences


def cited_in(text: str) -> set[tuple[str, str]]:
    """(first author, year) of the papers that a text cites as "Author and Author 2009" or "Author et al. 2020"."""
    name = r"[A-ZÀ-Ž][a-zà-ž]+"
    found = re.findall(rf"({name})(?: and {name}| et al\.),?\s+\(?((?:19|20)\d\d)\)?", text)
    return set(found)


def test_every_paper_that_the_code_cites_is_in_the_references() -> None:
    rows = [
        row for row in (ROOT / "REFERENCES.md").read_text(encoding="utf-8").splitlines() if row[:2] == "| "
    ]
    cited: set[tuple[str, str]] = set()
    for package in ("trainer", "runtime", "firmware_iface", "tests"):
        for path in [*(ROOT / package).rglob("*.py"), *(ROOT / package).rglob("*.md")]:
            if path != Path(__file__).resolve():
                cited |= cited_in(" ".join(path.read_text(encoding="utf-8").split()))
    assert len(cited) > 10
    for author, year in sorted(cited):
        assert any(re.search(rf"\b{author}\b.* {year}, ", row) for row in rows), f"{author} {year}"
