"""The tutorial's code runs."""

import re

from conftest import REPOSITORY


def test_the_tutorial_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = (REPOSITORY / "docs/python.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert len(blocks) > 7
    names = {}
    for block in blocks:
        # Lines are those of the page, in a traceback too.
        line = text[: text.index(block)].count("\n")
        exec(compile("\n" * line + block, "docs/python.md", "exec"), names)
    said = capsys.readouterr().out
    assert "map.nside = 7: expected a power of two" in said and "final map at 3 MHz" in said
    assert (tmp_path / "map.png").stat().st_size > 10_000 and (tmp_path / "channel1.uvh5").exists()
