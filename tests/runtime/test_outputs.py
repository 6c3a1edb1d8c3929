"""The one rule for what commands write: nothing is replaced by accident, and it is said before any work."""

from __future__ import annotations

import os
from argparse import Namespace
from pathlib import Path

import pytest

from firmware_iface.errors import InputError
from runtime.cli import PROGRAM as RUNTIME
from runtime.program.outputs import Output, check_outputs, emptied, files_written
from trainer.cli import PROGRAM as TRAINER

BUNDLE = ("bundle.json", "*.onnx")


def check(*outputs: Output, overwrite: bool = False, **inputs: object) -> None:
    check_outputs(outputs, Namespace(overwrite=overwrite, **inputs))


def filled(folder: Path, *names: str) -> Path:
    folder.mkdir()
    for name in names:
        (folder / name).write_text("kept")
    return folder


def test_every_command_has_overwrite_and_the_options_of_what_is_said() -> None:
    for program in (TRAINER, RUNTIME):
        for name, parser in program.parser().commands.items():
            options = parser.format_help()
            for option in ("--overwrite", "--quiet", "--verbose", "--log FILE", "--csv FILE.csv"):
                assert option in options, (name, option)


def test_a_file_that_is_there_is_refused_without_overwrite(tmp_path: Path) -> None:
    path = tmp_path / "model.toml"
    check(Output(path))
    path.write_text("kept")
    with pytest.raises(InputError, match=r"--out .*model.toml is there already: .*--overwrite"):
        check(Output(path))
    check(Output(path), overwrite=True)
    assert path.read_text() == "kept"


def test_a_folder_that_is_there_is_refused_unless_empty(tmp_path: Path) -> None:
    check(Output(filled(tmp_path / "empty"), contents=BUNDLE))
    folder = filled(tmp_path / "bundle", "bundle.json", "a.onnx")
    with pytest.raises(InputError, match="not empty: .*--overwrite"):
        check(Output(folder, contents=BUNDLE))
    check(Output(folder, contents=BUNDLE), overwrite=True)


def test_a_folder_that_holds_anything_else_is_never_replaced(tmp_path: Path) -> None:
    folder = filled(tmp_path / "home", "bundle.json", "thesis.tex")
    with pytest.raises(InputError, match=r"holds thesis.tex, which this command does not write"):
        check(Output(folder, contents=BUNDLE), overwrite=True)


def test_an_unfinished_run_is_continued(tmp_path: Path) -> None:
    folder = filled(tmp_path / "run", "checkpoint.pt")
    check(Output(folder, contents=("checkpoint.pt",), resumed_by=("checkpoint.pt",)))


def test_kinds_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a folder: give the name of a file"):
        check(Output(tmp_path), overwrite=True)
    with pytest.raises(InputError, match="is a file: give the name of a folder"):
        check(Output(tmp_path / "file", contents=BUNDLE), overwrite=True)
    with pytest.raises(InputError, match="not an ordinary file"):
        check(Output(Path(os.devnull)), overwrite=True)


def test_the_folder_above_is_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"there is no folder .*missing; make it first"):
        check(Output(tmp_path / "missing" / "model.toml"))
    check(Output(tmp_path / "missing" / "a" / "model.toml", makes_folders=True))
    for makes in (False, True):
        with pytest.raises(InputError, match=r"file is a file, not a folder"):
            check(Output(tmp_path / "file" / "model.toml", makes_folders=makes))
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # a superuser may write everywhere
    with pytest.raises(InputError, match="may not write in"):
        check(Output(tmp_path / "model.toml"))


def test_a_link_that_leads_to_itself_is_named(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(InputError, match="symbolic link that leads to itself"):
        check(Output(tmp_path / "loop"))


def test_an_input_is_not_replaced_except_the_model_that_is_gone_on_from(tmp_path: Path) -> None:
    captures, model = filled(tmp_path / "captures", "bench.toml"), tmp_path / "model.toml"
    model.write_text("")
    for overwrite in (False, True):
        with pytest.raises(InputError, match="is an input"):
            check(Output(model), overwrite=overwrite, network=model)
        with pytest.raises(InputError, match="is an input"):
            check(Output(captures, contents=("bench.toml",)), overwrite=overwrite, recorded=[captures])
        with pytest.raises(InputError, match="is a part of"):
            check(Output(captures / "bench.toml"), overwrite=overwrite, captures=captures)
        with pytest.raises(InputError, match="is an input"):
            check(Output(model), overwrite=overwrite, bench=str(model))
    with pytest.raises(InputError, match="--overwrite"):
        check(Output(model, goes_on_from=model), model=model)
    check(Output(model, goes_on_from=model), overwrite=True, model=model)


def test_a_folder_around_an_input_is_not_replaced(tmp_path: Path) -> None:
    captures = filled(filled(tmp_path / "loop") / "round-0")
    with pytest.raises(InputError, match="an input of this command"):
        check(Output(tmp_path / "loop", contents=("round-*",)), overwrite=True, recorded=[captures])


def test_two_outputs_are_two_files(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with pytest.raises(InputError, match="--out .* and --report .* are one file"):
        check(Output(path), *files_written(report=path, csv=None))


def test_emptied_keeps_what_it_is_told_to_and_does_not_follow_links(tmp_path: Path) -> None:
    outside = filled(tmp_path / "outside", "file")
    folder = filled(tmp_path / "run", "running", "checkpoint.pt")
    (folder / "curves").mkdir()
    (folder / "link").symlink_to(outside)
    emptied(folder, keep="running")
    assert [p.name for p in folder.iterdir()] == ["running"]
    assert (outside / "file").exists()
    emptied(tmp_path / "missing")
