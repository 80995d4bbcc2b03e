"""The notebooks in examples/: run, and shown in the docs with what they print.

    python recipes/notebooks.py            # runs each, writes docs/examples/NAME.md
    python recipes/notebooks.py --check    # runs each, writes nothing

The notebooks are kept without output. A kernel of this environment runs them, in an empty folder.
"""

from __future__ import annotations

import argparse
import base64
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

TOP = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((TOP / "examples").glob("*.ipynb"))
PAGES = TOP / "docs" / "examples"
#: Seconds that one cell may take.
LONGEST = 900


def run(path: Path, folder: Path) -> Any:
    """A notebook with the output of its cells, which run in ``folder``; a failing cell raises."""
    import nbclient
    import nbformat

    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=LONGEST, kernel_name="python3", resources={"metadata": {"path": folder}}
    )
    return client.execute()


def output_text(output: Any) -> str:
    """What one output says as text; progress, on standard error, says nothing."""
    if output.output_type == "stream":
        return "" if output.name == "stderr" else output.text
    return output.get("data", {}).get("text/plain", "")


def page(notebook: Any, name: str) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and its images by name."""
    parts, images = [], {}
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.outputs:
            if image := output.get("data", {}).get("image/png"):
                file = f"{name}_{len(images)}.png"
                images[file] = base64.b64decode(image)
                parts.append(f"![What the cell shows]({file})")
            elif text := output_text(output).rstrip():
                plain = re.sub(r"\x1b\[[0-9;]*m", "", text)
                parts.append(f"```text\n{plain}\n```")
    source = f"*This page is the notebook `examples/{name}.ipynb`, run by `make examples`.*"
    return "\n\n".join([parts[0], source, *parts[1:]]) + "\n", images


def main() -> int:
    """Run all notebooks, and write their pages."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="run, and write nothing")
    options = parser.parse_args()
    for path in NOTEBOOKS:
        with tempfile.TemporaryDirectory() as folder:
            text, images = page(run(path, Path(folder)), path.stem)
        if not options.check:
            PAGES.mkdir(exist_ok=True)
            (PAGES / f"{path.stem}.md").write_text(text, encoding="utf-8")
            for file, content in images.items():
                (PAGES / file).write_bytes(content)
    return 0


if __name__ == "__main__":
    sys.exit(main())
