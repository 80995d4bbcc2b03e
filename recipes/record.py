"""Keep a run of ``palpate reproduce`` in the repository: what was found, and how to find it again.

python recipes/record.py RUN -o docs/results/world-gelsight --commit abc1234 [--note "..."]

Writes index.md (claims, tables, curves, settings), settings.json
(digests, versions, and every stage with its time), samples.jpg and the curves as SVG.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image

from palpate.report.results import Results


def heading(results: Results, commit: str, notes: list[str]) -> str:
    """What was run, where, when, and how long it took."""
    settings: Mapping[str, Any] = results.settings
    stages = settings["stages"].values()
    days = sorted({s["date"] for s in stages})
    seconds = sum(s["seconds"] for s in stages)
    peak = max(s["peak_mb"] or 0 for s in stages)
    seeds = ", ".join(str(s) for s in settings["seeds"])
    rows = {
        "command": f"`{results.commands[0]}`",
        "commit of the trainings": commit,
        "preset, seeds": f"{settings['preset']}, {seeds}",
        "steps of each method": settings["options"]["steps of a method"],
        "machine": settings.get("machine", "not recorded"),
        "days": " to ".join(dict.fromkeys((days[0], days[-1]))),
        "time": f"{seconds / 3600:.1f} hours of stages, {len(stages)} of them",
        "largest stage": f"{peak / 1024:.1f} GiB",
    }
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
    listed = "".join(f"\n- {note}" for note in notes)
    return f"""# {results.title}: our record

Made by `python recipes/record.py`; do not edit by hand. Synthetic data: it shows what the code
does, not what real gels do.

| | |
|---|---|
{table}

![Photo, real touch, generated touch](samples.jpg)
{listed}
"""


def main() -> None:
    """Write the record of a run."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--commit", required=True)
    parser.add_argument("--note", nargs="*", default=[])
    args = parser.parse_args()
    results, output = Results.load(args.run / "results.json"), args.output
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        figures = {f.name: f for f in results.save_figures(place)}
        for name, file in figures.items():
            if name.startswith("curve-") and file.suffix == ".svg":
                (output / name).write_bytes(file.read_bytes())
        image = Image.open(figures["samples.png"]).convert("RGB")
        image.thumbnail((1600, 1600))
        image.save(output / "samples.jpg", quality=85)
    shown = replace(results, scores=[], notes=())
    settings = {k: v for k, v in results.settings.items() if k not in ("stages", "split rule")}
    text = replace(shown, settings=settings, facts=results.facts).to_markdown()
    body = text.partition("\n")[2]  # the heading is ours
    (output / "index.md").write_text(heading(results, args.commit, args.note) + body)
    (output / "settings.json").write_text(json.dumps(results.settings, indent=1) + "\n")


if __name__ == "__main__":
    main()
