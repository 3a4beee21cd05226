"""``python -m docs`` and ``python -m benchmarks`` check their place first, and keep what they have computed."""

import json
import shutil
import sys
import tempfile
import types
from pathlib import Path

import click
import pytest
from broken_streams import BROKEN
from click.testing import CliRunner

import benchmarks.__main__ as bench
import docs.__main__ as site
from benchmarks.harness import report
from docs import notebooks, pictures
from hjbjax.cli import gallery


@pytest.fixture(autouse=True)
def nothing_is_computed(monkeypatch):
    """What takes minutes must not be reached."""
    monkeypatch.setattr(site, "build", None)
    monkeypatch.setattr(pictures, "draw", None)
    monkeypatch.setattr(notebooks, "render", None)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["biuld"], "got 'biuld', wanted build [FOLDER], pictures"),
        (["build", "{}/file"], "is not a folder"),
        (["build", "{}/file/below"], "cannot be written"),
        (["build", "{}/" + "x" * 256], "too long"),
        (["pictures", "pendulum", "pendulm"], "did you mean 'pendulum'?"),
        (["notebooks", "no-such-notebook"], "unknown notebooks 'no-such-notebook'"),
    ],
)
def test_the_site_refuses_before_anything_is_computed(words, part, tmp_path, capsys):
    (tmp_path / "file").touch()
    assert site.main([word.format(tmp_path) for word in words]) == 2
    complaint = capsys.readouterr().err
    assert complaint.startswith("docs: ")
    assert part in complaint


def test_old_pictures_stay_until_all_new_ones_are_there(tmp_path, monkeypatch):
    (tmp_path / "old.png").write_bytes(b"old")

    def run(page, folder):
        (folder / f"{page.stem}.png").write_bytes(b"new")
        if stopped:
            raise KeyboardInterrupt

    monkeypatch.setattr(pictures, "run", run)
    monkeypatch.setattr(pictures, "shrink", lambda picture: None)
    stopped = True
    with pytest.raises(KeyboardInterrupt):
        pictures.pictures_of_pages(tmp_path, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["old.png"]
    stopped = False
    pictures.pictures_of_pages(tmp_path, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"README.png", "enclose.png", "getting_started.png"}


def test_the_pictures_of_a_card_are_those_of_its_page(tmp_path):
    card = gallery.Card("smooth", "a summary", "CONVERGED", (), (("the value", b"RIFF"), ("the feedback", b"RIFF")))
    pictures.write_pictures(card, tmp_path / "pictures" / "gallery")
    page = pictures.gallery_page([card])
    made = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*.webp"))
    assert len(made) == 2
    assert all(f"]({path})" in page for path in made)


@click.command()
@click.option("--out", type=report.Folder())
def measuring(out):
    """A benchmark."""
    for word in ("measured", "published"):
        click.echo(word)
        report.put(out, lambda folder, word=word: (folder / f"{word}.json").write_text("[1]"))


def test_a_benchmark_refuses_its_folder_before_anything_is_measured(tmp_path):
    (tmp_path / "file").touch()
    for name in ("file", "file/below", "x" * 256):
        result = CliRunner().invoke(measuring, ["--out", str(tmp_path / name)])
        assert result.exit_code == 2
        assert "measured" not in result.stdout


def test_rows_that_a_folder_no_longer_takes_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    out = tmp_path / "place" / "out"
    out.mkdir(parents=True)
    shutil.rmtree(out.parent)
    (tmp_path / "place").touch()
    monkeypatch.setattr(report, "stamped", lambda rows: rows)
    with pytest.raises(click.ClickException, match="they are in") as caught:
        report.publish(out, "sweep", [{"seconds": 1.0}])
    assert caught.value.exit_code == 5
    (file,) = Path(caught.value.message.rpartition("they are in ")[2]).iterdir()
    assert (file.name, json.loads(file.read_text())) == ("sweep.json", [{"seconds": 1.0}])


@pytest.mark.parametrize("kind", BROKEN)
def test_a_benchmark_whose_tables_nobody_reads_writes_its_rows(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(bench.importlib, "import_module", lambda _: types.SimpleNamespace(command=measuring))
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, BROKEN[kind]())
    with pytest.raises(SystemExit) as ended:
        bench.main(["sweep", "--out", str(tmp_path)])
    assert ended.value.code == 0
    assert {path.name for path in tmp_path.iterdir()} == {"measured.json", "published.json"}
