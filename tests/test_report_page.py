"""The page of the report: whole, self-contained, styled, and readable on a phone and on a dark laptop."""

import html.parser
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from report_files import HOSTILE, ROWS, log_row, make_films, write_evaluation, write_run

from pregrasp_jax.presets import PRESETS
from pregrasp_jax.report import load_evaluations, read_run, write_report
from pregrasp_jax.report.films import data_uri
from pregrasp_jax.settings import to_dict


class _Page(html.parser.HTMLParser):
    """Checks that elements are closed in order, and collects them."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []

    @classmethod
    def of(cls, text: str) -> "_Page":
        page = cls()
        page.feed(text)
        page.close()
        return page

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in {"meta", "img", "wbr"}:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture
def page(tmp_path: Path) -> Path:
    run_dir = write_run(tmp_path / "runs" / "first")
    for index, policy in enumerate(("first", "random", "a/policy/with/quite/a/long/path/that/is/no/use/on/a/phone")):
        write_evaluation(run_dir / "evaluations" / f"{index}.json", policy, [1, 0, 1, 1])
    run = read_run(run_dir)
    return write_report(run, load_evaluations(run), make_films(), films_note="Two of them.")


def test_the_page_is_whole_and_needs_nothing_else(page: Path) -> None:
    text = page.read_text()
    parsed = _Page.of(text)
    assert parsed.open == []
    assert text.startswith("<!DOCTYPE html>") and "prefers-color-scheme: dark" in text
    assert not re.search(r"https?:|url\(|@import|<script|<link|<iframe", text)
    for tag, attributes in parsed.elements:
        assert not {"onload", "onclick", "onerror"} & attributes.keys()
        if tag == "img":
            assert attributes["alt"] and attributes["width"] and attributes["height"]
            assert (attributes["src"] or "").startswith("data:image/")
        if tag == "svg":
            assert attributes["role"] == "img" and attributes["aria-label"]
    tags = [tag for tag, _ in parsed.elements]
    assert tags.count("img") == 2 * 8 * 5 and tags.count("h1") == 1 and tags.count("svg") >= 8
    assert "9.8.7" in text and "learner.<wbr>huber_<wbr>delta" in text and "Two of them." in text


def test_every_class_of_the_page_has_a_style_and_colours_are_equal_in_number(page: Path) -> None:
    text = page.read_text()
    style = text.split("<style>")[1].split("</style>")[0]
    used = {name for _, attributes in _Page.of(text).elements for name in (attributes.get("class") or "").split()}
    assert [name for name in sorted(used) if not re.search(rf"\.{name}\b", style)] == []
    light, dark = (set(re.findall(r"(--\w+):", block)) for block in re.findall(r":root \{(.*?)\}", style, re.S))
    assert light == dark == set(re.findall(r"var\((--\w+)\)", style))


def test_pictures_are_small_and_true() -> None:
    flat = np.full((300, 300, 3), (12, 200, 90), np.uint8)
    assert len(data_uri(flat, lossy=False)) < 1000 and data_uri(flat, lossy=False).startswith("data:image/png;base64,")
    assert data_uri(flat, lossy=True).startswith("data:image/jpeg;base64,")


def test_no_name_or_setting_gets_into_the_page_as_markup(tmp_path: Path) -> None:
    settings = to_dict(PRESETS["ci"])
    settings["assets"] |= {"object_dir": HOSTILE, "object_set": HOSTILE}
    run_dir = write_run(tmp_path / "<script>x", [*ROWS, log_row(500, 100, **{f"reasons/{HOSTILE}": 4})], **settings)
    manifest = {"sessions": [{"versions": {HOSTILE: HOSTILE}}], "hashes": {HOSTILE: HOSTILE}}
    (run_dir / "manifest.json").write_text(json.dumps(manifest))
    for policy in (HOSTILE, "<script>x"):
        file = run_dir / "evaluations" / f"{len(policy)}.json"
        write_evaluation(file, policy, [0, 1], object_set=HOSTILE, camera=HOSTILE, failures={HOSTILE: 1})
    run = read_run(run_dir)
    page = write_report(run, load_evaluations(run), make_films(), films_note=HOSTILE).read_text()
    assert "<script" not in page and page.count("&lt;script&gt;") > 10
    assert _Page.of(page).open == []


PROBE = """<!DOCTYPE html><meta charset="utf-8"><pre id="found">not loaded</pre>
<iframe id="page" style="width:{width}px;height:844px;border:0" srcdoc="{page}"></iframe>
<script>
addEventListener("load", () => {{
  const page = document.getElementById("page").contentDocument, root = page.documentElement;
  const wide = [...page.querySelectorAll("body *")].filter(e => !e.closest(".scroll *, svg *")
    && e.getBoundingClientRect().right > root.clientWidth + 0.5).map(e => e.tagName + "." + e.className);
  const pictures = [...page.images];
  document.getElementById("found").textContent = JSON.stringify({{
    viewport: root.clientWidth, width: Math.max(root.scrollWidth, page.body.scrollWidth), wide,
    pictures: pictures.length, loaded: pictures.filter(i => i.complete && i.naturalWidth > 0).length,
    paper: getComputedStyle(page.body).backgroundColor,
    small: [...page.querySelectorAll(".chart svg text")].filter(t => t.getBoundingClientRect().height < 9).length,
  }});
}});
</script>"""


def _browser() -> str | None:
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    found = next((path for path in map(shutil.which, names) if path), None)
    folders = [os.environ.get("PLAYWRIGHT_BROWSERS_PATH"), Path.home() / ".cache" / "ms-playwright"]
    patterns = ("chromium-*/chrome-linux*/chrome", "chromium_headless_shell-*/*/*headless*shell")
    kept = [str(file) for folder in folders if folder for pattern in patterns for file in Path(folder).glob(pattern)]
    return found or next(iter(sorted(kept)), None)


@pytest.mark.skipif(_browser() is None, reason="no Chromium on this machine")
@pytest.mark.parametrize(
    ("width", "options", "paper"),
    [(390, [], "rgb(251, 250, 247)"), (1366, ["--blink-settings=preferredColorScheme=0"], "rgb(21, 23, 26)")],
    ids=["phone", "laptop, dark"],
)
def test_a_browser_shows_the_page_without_error(
    page: Path, tmp_path: Path, width: int, options: list[str], paper: str
) -> None:
    # A headless window cannot be as narrow as a phone, a frame can; `srcdoc` makes it one origin with the probe.
    probe = tmp_path / "probe.html"
    probe.write_text(PROBE.format(width=width, page=page.read_text().replace("&", "&amp;").replace('"', "&quot;")))
    options = [*options, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--enable-logging=stderr"]
    profile = f"--user-data-dir={tmp_path / 'profile'}"
    size, budget = "--window-size=1600,900", "--virtual-time-budget=5000"
    command = [str(_browser()), *options, profile, size, budget, "--dump-dom", probe.as_uri()]
    result = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    dumped = re.search(r'<pre id="found">(.*?)</pre>', result.stdout, re.S)
    assert dumped, result.stdout[:500]
    found = json.loads(dumped[1])
    assert found["width"] <= found["viewport"] <= width
    assert {key: found[key] for key in ("wide", "pictures", "loaded", "small", "paper")} == {
        **{"wide": [], "pictures": 80, "loaded": 80, "small": 0, "paper": paper}
    }
    assert "CONSOLE" not in result.stderr


def test_the_page_of_a_run_of_strokes_speaks_of_strokes(tmp_path: Path) -> None:
    for name, method in (("first", "q_learning"), ("strokes", "imitation")):
        run_dir = write_run(tmp_path / name, train=to_dict(PRESETS["ci"].train) | {"method": method})
        text = write_report(read_run(run_dir), films=make_films()).read_text()
        assert ("Before every stroke" in text) == ("strokes and updates" in text) == (method == "imitation")
        assert ("Before every push" in text) == ("plays the averaged network" in text) == (method == "q_learning")
