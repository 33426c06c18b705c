"""What is written about the package is true: the code of the README, of the guide and of the notebook runs."""

import json
import re

import pytest

import gump
from conftest import REPOSITORY

BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(path):
    return BLOCK.findall((REPOSITORY / path).read_text())


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch):
    monkeypatch.chdir(REPOSITORY)


@pytest.mark.parametrize("page", ["README.md", "crates/gump-python/README.md"])
def test_five_lines(page, monkeypatch, capsys):
    (code,) = blocks(page)
    assert len([line for line in code.splitlines() if line.strip()]) == 5
    # One scene is enough to see that it runs.
    (one,) = [gump.find("datasets/mini/procedural.tfrecord.gz#17")]
    monkeypatch.setattr(gump, "open", lambda path: iter([one]))
    exec(compile(code, page, "exec"), {})
    assert 0.5 < float(capsys.readouterr().out) < 1.0


def test_the_guide():
    page = "docs/guide/src/from-python.md"
    names = {}
    code = blocks(page)
    assert len(code) >= 7
    for block in code:
        exec(compile(block, page, "exec"), names)
    assert 0.0 <= names["drive"].score <= 1.0
    assert names["scores"].rewards.shape == (4,)


def test_the_table_names_what_there_is():
    table = (REPOSITORY / "docs/guide/src/from-python.md").read_text().split("## Instead of")[1]
    names = set(re.findall(r"`(gump(?:\.\w+)+)", table))
    assert len(names) >= 6
    for name in names:
        found = gump
        for part in name.split(".")[1:]:
            if not hasattr(found, part):
                __import__(f"{found.__name__}.{part}")
            found = getattr(found, part)


def test_the_notebook():
    pytest.importorskip("matplotlib").use("Agg")
    import matplotlib.pyplot

    path = REPOSITORY / "python/notebooks/quickstart.ipynb"
    cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    names, pictures = {}, 0
    for cell in cells:
        exec(compile("".join(cell["source"]), path.name, "exec"), names)
        pictures += len(matplotlib.pyplot.get_fignums())
        matplotlib.pyplot.close("all")
    shown = [output for cell in cells for output in cell["outputs"] if "image/png" in output.get("data", {})]
    assert pictures == len(shown) >= 4
    assert names["scores"]["model"].metametric > names["scores"]["constant-velocity"].metametric
