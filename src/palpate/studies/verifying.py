"""Does a results file come out again? What made it is run once more, and the two are compared.

A results file names the calls that made its scores and audits (:mod:`palpate.report.results`): each
is made again on the files of today. Results in a run folder name its stages instead: those that
train must hold the files of their records, and those that measure (splits and audits, probes,
scores, tables) are built again in a temporary folder from the stored data, images and encoders.

Numbers agree if ``|a - b| <= tolerance * max(|a|, |b|)``, or to the sixth decimal: scores near zero
are differences of sums over embeddings of 32 bits, whose last ones depend on processor and threads.
Words, counts and digests must be equal. Notes, times and places of files are not compared.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from palpate.core import PalpateError, Progress, few, plain, quiet, require
from palpate.core.files import is_there, reading_entry
from palpate.core.shown import Shown
from palpate.report.labels import label_of, subject_of
from palpate.report.results import OBJECT, PATH, ROWS, SILENT, Audit, Call, Results
from palpate.studies.graph import Work
from palpate.studies.stages import Stage, stage_outputs, stored_stage

FORMAT = "palpate-verification/1"
#: Verb -> module and function of its calls.
FUNCTIONS = {
    "score": ("palpate.evaluation.scoring", "score"),
    "probe": ("palpate.evaluation.probing", "probe"),
    "audit": ("palpate.evaluation.auditing", "audit"),
    "caption check": ("palpate.captions.checking", "check_captions"),
    "preference score": ("palpate.preference.scoring", "score"),
}
#: Lists of results whose items are compared.
PARTS = ("calls", "scores", "audits", "facts", "tables", "claims", "strips")
#: Relative, for sums whose order may change from run to run.
TOLERANCE = 1e-6
#: Absolute, where the relative one is not 0.
DECIMAL = 1e-6
#: The least tolerance of some numbers. Descriptors of near-duplicates have 16 and 32 bits: another
#: order of their sums moves a threshold by 3e-5, and the score of a pair, of four digits, by one of
#: them. p-values and effect sizes of untrained models, 1e-5 apart, are moved by 2e-3.
LEAST = {
    **dict.fromkeys(("threshold", "score"), 5e-4),
    **dict.fromkeys(("p_value", "p_better", "p_adjusted", "effect size"), 5e-3),
}
#: Keys of what no later run repeats, and of places of files.
PASSING = ("notes", "commands", "version", "stage", "seconds", PATH)
PLACES = ("vision", "tactile", "background")

Status = Literal["same", "differs", "cannot check"]


@dataclass(frozen=True)
class Check:
    """What became of one score, audit, table, claim, sentence, call or stage, and why."""

    name: str
    status: Status
    why: str = ""


@dataclass(frozen=True)
class Verification(Shown):
    """All checks of one results file."""

    file: str
    checks: Sequence[Check]

    @property
    def counts(self) -> dict[str, int]:
        """How many checks ended in each status."""
        count = Counter(check.status for check in self.checks)
        return {status: count[status] for status in ("same", "differs", "cannot check")}

    @property
    def ok(self) -> bool | None:
        """Whether all is the same; None: nothing differs, but not all could be checked."""
        statuses = {check.status for check in self.checks}
        if "differs" in statuses:
            return False
        return True if statuses == {"same"} else None

    def __str__(self) -> str:
        """The counts, then a line for each difference and for each reason of no check."""
        counts = self.counts
        lines = [", ".join(f"{status} {count}" for status, count in counts.items())]
        if self.ok is None:
            part = f"{counts['cannot check']} of {len(self.checks)}"
            lines.append(f"cannot tell: {part} could not be checked")
        lines += [f"differs: {c.name}: {c.why}" for c in self.checks if c.status == "differs"]
        unchecked = [check for check in self.checks if check.status == "cannot check"]
        for why in dict.fromkeys(check.why for check in unchecked):
            lines.append(f"cannot check: {few(c.name for c in unchecked if c.why == why)}: {why}")
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """A JSON object with ``format: palpate-verification/1``."""
        checks = plain(self.checks)
        facts = {"file": self.file, "ok": self.ok, "counts": self.counts, "checks": checks}
        return {"format": FORMAT, **facts}


def verify(
    path: str | Path,
    *,
    tolerance: float = TOLERANCE,
    trust_torchscript: bool = False,
    progress: Progress = quiet,
) -> Verification:
    """Make the results of a file again and compare every number.

    Args:
        path: a file of ``palpate score -o``, ``palpate probe -o``, ``palpate audit -o``,
            ``palpate preference score -o``, ``palpate caption check -o``, the JSON of a page, or
            results in a run folder.
        tolerance: relative difference up to which two numbers are the same, in [0, 1); the default
            is for sums whose order may change. Digests and counts must be equal.
        trust_torchscript: run the code in a TorchScript file that the results name.
        progress: called with what is done.

    Raises:
        PalpateError: if the file is missing or no results of palpate.
    """
    require(0 <= tolerance < 1, "tolerance", "must lie in [0, 1)", tolerance, TOLERANCE)
    file = Path(path)
    results = Results.load(file)
    staged = isinstance(results.settings.get("stages"), Mapping)
    again = _run_again if staged else _calls_again
    after, reasons = again(results, file, trust_torchscript, progress)
    checks = list[Check]()
    before = _items(results)
    for name in dict.fromkeys([*before, *after]):
        if name not in after and reasons:
            checks.append(Check(name, "cannot check", "; ".join(dict.fromkeys(reasons))))
        elif name not in after or name not in before:
            where = "in the file, not made again" if name in before else "not in the file"
            checks.append(Check(name, "differs", where))
        else:
            why = difference(before[name], after[name], tolerance)
            checks.append(Check(name, "differs" if why else "same", why))
    return Verification(str(file), checks)


def _items(*results: Results) -> dict[str, Any]:
    """Every score, audit, sentence, table, claim, strip and call by what it is called."""
    items, seen = dict[str, Any](), Counter[str]()
    for part, item in ((p, i) for p in PARTS for r in results for i in getattr(r, p)):
        name = _name(part, item)
        seen[name] += 1
        items[name if seen[name] == 1 else f"{name} ({seen[name]})"] = plain(item)
    for settings in (r.settings for r in results):
        if isinstance(stages := settings.get("stages"), Mapping):
            items["digests"] = plain(settings.get("digests"))
            for name, record in stages.items():
                outputs = record.get("outputs") if isinstance(record, Mapping) else record
                items[f"stage {name}"] = outputs
    return items


def _name(part: str, item: Any) -> str:
    if part == "scores":
        preset = item.settings.get("preset")
        return f"{label_of(item)} of {subject_of(item)}" + (f" ({preset})" if preset else "")
    if part == "facts":
        return f"fact {item[:60]!r}"
    if part == "strips":
        return f"retrieved {item.keys} for {item.queries} {item.query.id}"
    key = {"calls": "verb", "audits": "name", "tables": "title", "claims": "claim"}[part]
    return f"{part.removesuffix('s')} {getattr(item, key)}"


def _calls_again(
    results: Results, file: Path, trust_torchscript: bool, progress: Progress
) -> tuple[dict[str, Any], list[str]]:
    """The items that the calls of a file make now, and why some calls cannot be made."""
    calls = [*results.calls, *(a.call for a in results.audits if a.call is not None)]
    again = list[Results]()
    reasons = [] if calls else ["no call in the file makes it"]
    for call in calls:
        try:
            with reading_entry(file, f"The call of palpate {call.verb}"):
                again.append(_call_again(call, trust_torchscript, progress))
        except (PalpateError, OSError) as error:
            reasons.append(" ".join(str(error).split()))
    return _items(*again), reasons


def _call_again(call: Call, trust_torchscript: bool, progress: Progress) -> Results:
    """What a call makes now.

    Raises:
        PalpateError: if an input is missing, or never was a file.
    """
    must = f"The verb of a call must be one of {', '.join(FUNCTIONS)}"
    require(call.verb in FUNCTIONS, None, must, repr(call.verb), fix="Run it again yourself")
    module, name = FUNCTIONS[call.verb]
    function = partial(getattr(import_module(module), name), progress=progress)
    if "inception" in call.arguments:
        function = partial(function, trust_torchscript=trust_torchscript)
    results = function(
        **{n: _decoded(value) for n, value in call.arguments.items() if n not in SILENT}
    )
    return results.to_results() if isinstance(results, Audit) else results


def _decoded(value: Any) -> Any:
    """An argument as it was, read from its file.

    Raises:
        PalpateError: if the file is missing, or there never was one.
    """
    if isinstance(value, Mapping) and OBJECT in value:
        must, got = "An input must be a file or a folder", f"{value[OBJECT]} in memory"
        raise PalpateError(must, got, "Save it, and pass its path")
    if isinstance(value, Mapping) and PATH in value:
        path = Path(value[PATH])
        got, fix = f"nothing at {path}", "Put it there again"
        require(is_there(path), None, "An input must exist", got, fix=fix)
        if ROWS in value:  # of a manifest in memory: as its folder has it, or as it is read
            from palpate.data.manifest import Manifest
            from palpate.data.reading import load

            manifest = Manifest.load(path)
            return manifest if manifest.digest == value[ROWS] else load(path)
        return path
    if isinstance(value, Mapping):
        return {key: _decoded(item) for key, item in value.items()}
    return [_decoded(item) for item in value] if isinstance(value, list) else value


def _run_again(
    results: Results, file: Path, trust_torchscript: bool, progress: Progress
) -> tuple[dict[str, Any], list[str]]:
    """What the stages next to a file hold and make now, and why some cannot be made."""
    from palpate.studies.demo import Demo
    from palpate.studies.reproduce import plan_again

    folder, settings = file.absolute().parent, results.settings
    folders = {name: folder / name for name in settings["stages"]}
    absent = [name for name, path in folders.items() if not (path / "stage.json").is_file()]
    reasons = [f"no record at {folders[name]}" for name in absent]
    items = {f"stage {n}": stage_outputs(f) for n, f in folders.items() if n not in absent}
    with tempfile.TemporaryDirectory() as target:
        try:
            with reading_entry(file, "The settings"):
                demo = settings["study"] == Demo.name
                plan = (
                    Demo.again(settings)
                    if demo
                    else plan_again(settings, folder, trust_torchscript)
                )
                stages, nodes = dict[str, Stage](), plan.nodes()
                for done, node in enumerate(nodes):
                    progress("stages", done, len(nodes), node.name)
                    stage = stored_stage(folder / node.name)
                    if node.measures:  # built again of what is stored, and of what was built again
                        (again := Path(target, node.name)).mkdir()
                        after = {name: stages[name].folder for name in node.after}
                        facts = dict(node.build(Work(again, after, Path(target, "cache"))) or {})
                        stage = replace(
                            stage, folder=again, record={**stage.record, "facts": facts}
                        )
                    stages[node.name] = stage
                return _items(plan.results(stages)) | items, reasons
        except (PalpateError, OSError) as error:
            return items, [*reasons, " ".join(str(error).split())]


def difference(before: Any, after: Any, tolerance: float) -> str:
    """Where two JSON values differ first, with both numbers; '' where they agree."""
    return next(_differences(before, after, tolerance, ""), "")


def _differences(a: Any, b: Any, tolerance: float, name: str) -> Iterator[str]:
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        if a.get("kind") == "effect size":
            tolerance = max(tolerance, LEAST["effect size"])
        for key in dict.fromkeys([*a, *b]):
            x, y = a.get(key), b.get(key)
            file = key in PLACES and all(isinstance(value, str | None) for value in (x, y))
            if key not in PASSING and not file:
                least = max(tolerance, LEAST.get(key, 0.0))
                yield from _differences(x, y, least, f"{name} {key.replace('_', ' ')}".strip())
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for k, (x, y) in enumerate(zip(a, b, strict=True), 1):
            yield from _differences(x, y, tolerance, f"{name} {k}")
    elif not _close(a, b, tolerance):
        yield f"{name} {_text(a)} in the file, {_text(b)} now".strip()


def _close(a: Any, b: Any, tolerance: float) -> bool:
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in (a, b))
    if not numbers or (isinstance(a, int) and isinstance(b, int)):
        return type(a) is type(b) and a == b
    return abs(a - b) <= max(tolerance * max(abs(a), abs(b)), DECIMAL * (tolerance > 0))


def _text(value: Any) -> str:
    """A value in a line: a float by the digits that tell it from others, a list by its length."""
    if isinstance(value, float):
        return f"{value:.8g}"
    if isinstance(value, list | Mapping):
        return f"{len(value)} entries"
    return "nothing" if value is None else f"{value}"[:80]
