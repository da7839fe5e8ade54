"""How results are printed: in 80 characters, and in any encoding."""

import io
import subprocess
import sys

import pytest

from agents.cli import one_line_errors
from agents.console_output import format_table, print_in_80_columns, print_texts_and_tables

WORDS = [f"column {i} of many" for i in range(30)]


@pytest.mark.parametrize("columns", ["60", "80", "400"])
@pytest.mark.parametrize("markdown", [False, True])
def test_a_table_that_is_too_wide_is_several_with_the_same_labels(capsys, monkeypatch, columns, markdown):
    monkeypatch.setenv("COLUMNS", columns)
    rows = [["first", *["a value that is long"] * 29], ["a policy with a name " * 9, *map(str, range(1000, 1029))]]
    print_texts_and_tables(format_table(WORDS, rows, markdown=markdown, title="once"))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= min(80, int(columns))
    printed = "\n".join(lines)
    assert printed.count("once") == 1
    assert all(str(number) in printed for number in range(1000, 1029))
    if markdown:
        heads = [cell.strip() for line in lines if WORDS[0] in line for cell in line.strip().strip("|").split("|")]
        assert [head for head in heads if head != WORDS[0]] == WORDS[1:]


def test_a_text_is_broken_between_words_and_a_path_is_not(capsys):
    path = "/" + "folder-of-a-run/" * 8
    print_in_80_columns("word " * 40 + path + "\n  indented")
    *words, whole, last = capsys.readouterr().out.splitlines()
    assert " ".join(words) == ("word " * 40).strip()
    assert max(map(len, words)) <= 80
    assert (whole, last) == (path, "  indented")


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp437", "utf-8"])
def test_letters_that_an_encoding_lacks_are_spelled(encoding, monkeypatch):
    text = "m x'' + b x³ ± γ N s²/mm é 語 …"
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    with one_line_errors("x"):
        print_texts_and_tables(text, format_table(("", "mean"), [["c", "1 N s/mm³"]]))
    stream.flush()
    printed = stream.buffer.getvalue().decode(encoding)
    if encoding == "utf-8":
        assert printed.startswith(text)
    if encoding == "ascii":
        assert printed.startswith("m x'' + b x^3 +/- gamma N s^2/mm e ? ...\n")
        assert "1 N s/mm^3" in printed
        assert "-----" in printed


def test_a_command_ends_well_on_a_terminal_of_ascii(tmp_path):
    code = "from agents.commands import main; main(['export', 'prbs', '-o', 'größe³.csv', '--samples', '32'])"
    environment = {"PYTHONIOENCODING": "ascii", "PATH": "", "PYTHONPATH": str(sys.path[0]), "PYTHONUTF8": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, cwd=tmp_path, env=environment, timeout=300)
    assert done.stderr == b""
    assert done.stdout.startswith(b"grosse^3.csv: 32 samples") or done.stdout.startswith(b"gro?e^3.csv: 32 samples")
