"""The report: one file, whole, readable in a browser without a network."""

import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from agents.evaluation.comparison_tables import ComparisonSettings
from agents.evaluation.html_report import write_html_report
from agents.evaluation.policy_evaluation import evaluate_policies

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
VOID = {"meta", "br", "link", "img", "path", "use", "rect", "circle"}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    evaluations = evaluate_policies(["uniform", "prbs"], systems=4, options={"horizon": 40, "max_output": 0.3})
    settings = ComparisonSettings("duffing_env/Amplitude-v0", 4, 0, {"note": "<b>&"})
    write_html_report(path, evaluations, settings, ["evaluate.py", "--options", '{"a": "<script>"}'])
    return path


class Balance(HTMLParser):
    """Open elements, and every address that the page asks for."""

    def __init__(self):
        super().__init__()
        self.open, self.addresses, self.tags = [], [], []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.addresses += [value for name, value in attributes if name in ("src", "href", "xlink:href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)
        self.addresses += [value for name, value in attributes if name in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag


def test_the_page_is_whole_and_asks_for_nothing(page):
    text = page.read_text()
    parser = Balance()
    parser.feed(text)
    assert parser.open == []
    assert parser.tags.count("svg") == 4
    assert "script" not in parser.tags
    assert [address for address in parser.addresses if not address.startswith("#")] == ["evaluation.json"]
    assert not re.search(r"url\(\s*['\"]?http|@import", text)
    assert "<b>&" not in text
    assert "evaluate.py --options {&quot;a&quot;: &quot;&lt;script&gt;&quot;}" in text
    assert all(f"<td>{estimator}</td>" in text for estimator in ("structured", "mean field", "auditor"))


def test_the_page_is_the_same_for_the_same_evaluations(page, tmp_path):
    evaluations = evaluate_policies(["uniform"], systems=2, options={"horizon": 20})
    settings = ComparisonSettings("duffing_env/Amplitude-v0", 2, 0, {})
    for name in ("a.html", "b.html"):
        write_html_report(tmp_path / name, evaluations, settings, ["evaluate.py"])
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
@pytest.mark.parametrize("width", [390, 1200])
def test_a_browser_shows_it_without_overflow(page, tmp_path, width):
    measure = "[document.documentElement.scrollWidth, innerWidth, document.querySelectorAll('svg').length].join(' ')"
    script = f"<script>addEventListener('load', () => document.title = {measure})</script>"
    probed = tmp_path / "probed.html"
    probed.write_text(page.read_text().replace("</head>", script + "</head>"))
    done = subprocess.run(
        [
            CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync",
            "--disable-background-networking", "--disable-component-update", "--disable-quic",
            f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},900", "--dump-dom", probed.as_uri(),
        ],
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    content, window, figures = map(int, re.search(r"<title>(\d+) (\d+) (\d+)</title>", done.stdout).groups())
    assert figures == 4
    assert content <= window


TITLES = ["$\\frac{$", "<script>alert(1)</script>", "\x1b[31mred", "=1+1", "\\textbf{b}", "$x$"]


def test_no_name_is_taken_for_code(tmp_path):
    """Users choose the names of policies: no formula, element or control code may come of them."""
    (first, *_) = evaluate_policies(["uniform"], systems=4, options={"horizon": 8})
    settings = ComparisonSettings("duffing_env/Amplitude-v0", 4, 0, {})
    named = [replace(first, policy=title) for title in TITLES]
    write_html_report(tmp_path / "report.html", named, settings, ["evaluate.py"])
    parser = Balance()
    parser.feed((tmp_path / "report.html").read_text())
    assert parser.open == []
    assert parser.tags.count("svg") == 4
    assert "script" not in parser.tags
