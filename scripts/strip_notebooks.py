"""Remove outputs and execution counts from notebooks; status 1 if one had any. Used by pre-commit.

python scripts/strip_notebooks.py NOTEBOOK ...
"""

import sys

import nbformat


def strip(path: str) -> bool:
    """Rewrite a notebook without what running it left; return whether something was removed."""
    notebook = nbformat.read(path, as_version=4)
    left = False
    for cell in notebook.cells:
        if cell.cell_type == "code":
            left = left or bool(cell.outputs) or cell.execution_count is not None
            cell.outputs, cell.execution_count = [], None
        left = left or bool(cell.metadata)
        cell.metadata = {}
    if left:
        nbformat.write(notebook, path)
    return left


if __name__ == "__main__":
    sys.exit(int(sum(map(strip, sys.argv[1:])) > 0))  # all of them, not the first only
