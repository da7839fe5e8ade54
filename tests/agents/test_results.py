"""How results are printed."""

from agents.results import show, table


def test_a_table_for_the_manual_is_as_wide_as_its_cells(capsys):
    titles = [f"column {i} of many" for i in range(30)]
    show(table(titles, [["a value that is long"] * 30], markdown=True))
    lines = [line for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert [cell.strip() for cell in lines[0].strip().strip("|").split("|")] == titles
    assert lines[2].count("a value that is long") == 30
