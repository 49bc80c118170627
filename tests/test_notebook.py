"""The notebook runs from its first cell to its last."""

from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parent.parent / "examples" / "notebook" / "reach.ipynb"


@pytest.mark.slow
def test_every_cell_runs(tmp_path):
    nbclient = pytest.importorskip("nbclient")
    import nbformat

    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells)  # committed without them
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    shown = str(outputs)
    assert "RL301" in shown
    assert notebook.cells[6].outputs[0].data["text/plain"] == "[]"  # mended
    assert "image/png" in shown  # the learning curve
    assert "video/mp4" in shown
    assert (tmp_path / "reach.onnx").is_file()
