"""The ending of a name says what a file holds, or it is refused before any work."""

import importlib.util
import sys

import numpy as np
import pytest
from PIL import Image

from pregrasp_jax import drawing
from pregrasp_jax.cli import commands, replay, report
from pregrasp_jax.cli.evaluate import evaluate
from pregrasp_jax.cli.outputs import refuse_unwritable
from pregrasp_jax.drawing import files
from pregrasp_jax.evaluation_config import EvaluationConfig

FRAMES = [np.full((21, 35, 3), color, np.uint8) for color in ((200, 40, 20), (20, 180, 60), (40, 60, 220))]
"""Of odd height and width, which H.264 does not know."""

IMAGES = ".png, .jpg, .jpeg, .webp"


@pytest.mark.parametrize(
    ("name", "kind", "error"),
    [("a.png", "PNG", 0), ("a.JPG", "JPEG", 4), ("a.jpeg", "JPEG", 4), ("a.webp", "WEBP", 0)],
)
def test_a_picture_is_what_its_name_says(tmp_path, name, kind, error):
    drawing.save_image(tmp_path / name, FRAMES[0])
    with Image.open(tmp_path / name) as picture:
        assert picture.format == kind and picture.size == (35, 21)
        assert np.abs(np.asarray(picture.convert("RGB")).astype(int) - FRAMES[0]).max() <= error


@pytest.mark.parametrize(("name", "kind"), [("a.gif", "GIF"), ("a.WebP", "WEBP")])
def test_an_animation_is_what_its_name_says(tmp_path, name, kind):
    drawing.save_film(tmp_path / name, FRAMES, seconds_per_frame=0.5)
    with Image.open(tmp_path / name) as film:
        assert film.format == kind and getattr(film, "n_frames", 1) == 3 and film.info["loop"] == 0
        for number, frame in enumerate(FRAMES):
            film.seek(number)
            film.load()
            assert film.info["duration"] == 500
            assert np.abs(np.asarray(film.convert("RGB")).astype(int) - frame).max() <= 4


def test_an_mp4_shows_every_frame_for_its_time(tmp_path):
    av = pytest.importorskip("av")
    drawing.save_film(tmp_path / "a.mp4", FRAMES, seconds_per_frame=0.5)
    with av.open(tmp_path / "a.mp4") as film:
        stream = film.streams.video[0]
        assert "mp4" in film.format.name and stream.codec_context.name == "h264" and stream.pix_fmt == "yuv420p"
        pictures = [(float(picture.time), picture.to_ndarray(format="rgb24")) for picture in film.decode(stream)]
        assert film.duration == pytest.approx(1.5e6, rel=0.01), "microseconds"
    assert len(pictures) == 15 and pictures[0][1].shape == (22, 36, 3)
    for time, picture in pictures:
        expected = FRAMES[int(time / 0.5 + 1e-6)]
        assert np.abs(picture[:21, :35].astype(int) - expected).max() <= 8


NAMES = [
    ("image", "a.gif", IMAGES),
    ("image", "a.pdf", IMAGES),
    ("image", "a", IMAGES),
    ("film", "a.png", ".gif, .webp, .mp4"),
    ("film", "a.avi", ".gif, .webp, .mp4"),
    ("json", "a.yaml", ".json"),
    ("json", "stdout", ".json"),
    ("html", "a.pdf", ".html, .htm"),
]


@pytest.mark.parametrize(("kind", "name", "allowed"), NAMES)
def test_another_ending_is_refused_with_those_that_are_allowed(tmp_path, kind, name, allowed):
    with pytest.raises(ValueError) as error:
        refuse_unwritable(tmp_path / name, kind)
    said = f"{tmp_path / name}: nothing can be written under this ending; allowed are {allowed}"
    assert str(error.value) == said


@pytest.mark.parametrize(
    "save", [lambda path: drawing.save_image(path, FRAMES[0]), lambda path: drawing.save_film(path, FRAMES)]
)
def test_a_library_call_is_refused_too(tmp_path, save):
    with pytest.raises(ValueError, match="nothing can be written under this ending"):
        save(tmp_path / "a.bmp")
    assert not list(tmp_path.iterdir())


def test_an_mp4_without_its_extra_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, files.ENCODER, None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError) as error:
        refuse_unwritable(tmp_path / "a.mp4", "film")
    said = '.mp4 needs av; install it with `pip install "pregrasp_jax[video]"`; allowed without it are .gif and .webp'
    assert said in str(error.value)


OPTIONS = {
    "evaluate --video": lambda bad: evaluate(EvaluationConfig(policy="none"), video=bad),
    "evaluate --json": lambda bad: evaluate(EvaluationConfig(policy="none"), json_file=bad),
    "assets --png": lambda bad: commands.assets(bad.parent / "none", png=bad),
    "scenes --png": lambda bad: commands.scenes(object_dir="none", png=bad),
    "show --png": lambda bad: commands.show(policy="none", png=bad),
    "compare --json": lambda bad: commands.compare(bad.parent / "none", bad.parent / "none", json=bad),
    "replay-dump --png": lambda bad: replay.replay_dump(bad.parent / "none", png=bad),
}


@pytest.mark.parametrize("option", OPTIONS)
def test_no_command_works_for_a_name_that_says_nothing(tmp_path, option):
    """What each is asked to work on does not exist: it would be refused for that if it had begun."""
    with pytest.raises(ValueError, match=r"out\.xyz: nothing can be written under this ending; allowed are \."):
        OPTIONS[option](tmp_path / "out.xyz")


def test_a_report_is_html(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "read_run", lambda path: None)
    monkeypatch.setattr(report, "load_evaluations", lambda *_: [])
    with pytest.raises(ValueError, match=r"out\.xyz: nothing can be written under this ending; allowed are \.html"):
        report.report(tmp_path, html=tmp_path / "out.xyz")
