"""Results made again: what their inputs hash to now, and what each of their numbers comes to.

A results file names the calls that made its scores and audits (:mod:`palpate.report.calls`). Each
is made again on the files of today, and every number of the file is compared with what comes out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Progress, Score, few, plain, quiet, read_record, require
from palpate.core.files import reading_entry
from palpate.report.calls import DIGEST, OBJECT, PATH, ROWS, Call, digest_of, is_there
from palpate.report.results import AUDIT_FORMAT, RESULTS_FORMAT, Audit, Results, Strip
from palpate.studies.comparing import (
    STATUSES,
    TOLERANCE,
    Check,
    Status,
    audit_numbers,
    number_difference,
    score_difference,
    score_name,
)
from palpate.studies.verifying_runs import is_run, verify_run

FORMAT = "palpate-verification/1"
#: Verb -> module and function of its calls.
FUNCTIONS = {
    "score": ("palpate.evaluation.scoring", "score"),
    "probe": ("palpate.evaluation.probing", "probe"),
    "audit": ("palpate.evaluation.auditing", "audit"),
    "probe --train": ("palpate.studies.verifying_runs", "compare_splits_again"),
    "caption check": ("palpate.captions.checking", "check_captions"),
    "preference score": ("palpate.preference.scoring", "score"),
}
NO_CALL = "no call in the file makes it"


@dataclass(frozen=True)
class Verification:
    """All checks of one results file.

    Attributes:
        file: its path.
        checks: inputs first, then the numbers in the order of the file.
        tolerance: relative difference up to which two numbers are the same.
    """

    file: str
    checks: Sequence[Check]
    tolerance: float

    @property
    def counts(self) -> dict[str, int]:
        """How many checks ended in each status."""
        count = Counter(check.status for check in self.checks)
        return {status: count[status] for status in STATUSES}

    @property
    def ok(self) -> bool:
        """Whether nothing differs and nothing is untraced."""
        return not (self.counts["differs"] or self.counts["untraced"])

    @property
    def lines(self) -> list[str]:
        """The counts, then a line for each difference and for each other reason."""
        lines = [", ".join(f"{status} {count}" for status, count in self.counts.items())]
        lines += [f"differs: {c.name}: {c.why}" for c in self.checks if c.status == "differs"]
        for status in ("cannot check", "untraced"):
            reasons: dict[str, list[str]] = {}
            for check in self.checks:
                if check.status == status:
                    reasons.setdefault(check.why, []).append(check.name)
            lines += [f"{status}: {few(names)}: {why}" for why, names in reasons.items()]
        return lines

    def __str__(self) -> str:
        """The lines of :attr:`lines`."""
        return "\n".join(self.lines)

    def to_json(self) -> dict[str, Any]:
        """A JSON object with ``format: palpate-verification/1``."""
        facts = {"file": self.file, "tolerance": self.tolerance, "ok": self.ok}
        return {"format": FORMAT, **facts, **{"counts": self.counts, "checks": plain(self.checks)}}


@dataclass(frozen=True)
class Again:
    """A call made again: its result, or why there is none."""

    call: Call
    result: Results | Audit | None
    reason: str = ""


def verify(
    path: str | Path, *, tolerance: float = TOLERANCE, progress: Progress = quiet
) -> Verification:
    """Make the results of a file again and compare every number.

    Args:
        path: a file of ``palpate score -o``, ``palpate probe -o``, ``palpate audit -o``,
            ``palpate preference score -o``, ``palpate caption check -o``, the JSON of a page, or
            results in a run folder (:mod:`palpate.studies.verifying_runs`).
        tolerance: relative difference up to which two numbers are the same, in [0, 1); the default
            is for sums whose order may change. Digests and counts must be equal.
        progress: called with what is done.

    Raises:
        PalpateError: if the file is missing or no results of palpate.
    """
    require(0 <= tolerance < 1, "tolerance", "must lie in [0, 1)", tolerance, TOLERANCE)
    file = Path(path)
    results = read_results(file)
    scores, checks = numbers_of(results), list[Check]()
    if is_run(results):
        checks, scores = verify_run(file, results, tolerance, progress)
        results = replace(results, audits=[], facts=[], strips=[])  # verified with the run
    calls = [*results.calls, *(a.call for a in results.audits if a.call is not None)]
    made = [repeat(call, file, progress) for call in calls]
    checks += [check for again in made for check in input_checks(again)]
    checks += _score_checks(scores, made, tolerance)
    checks += _audit_checks(results.audits, made, tolerance)
    checks += _fact_checks(results.facts, made)
    checks += _strip_checks(results.strips, made, tolerance)
    return Verification(str(file), _distinct(checks), tolerance)


def read_results(file: Path) -> Results:
    """The results of a file, or its audit as results; paths are from the working directory.

    Raises:
        PalpateError: if it is missing, or holds neither.
    """
    data = read_record(file, "results file", form=(RESULTS_FORMAT, AUDIT_FORMAT))
    if data["format"] == AUDIT_FORMAT:
        return Results(title="", audits=[Audit.load(file)])
    return Results.load(file)


def numbers_of(results: Results) -> list[Score]:
    """Every score of the file: in its list, its tables, its curves and its claims."""
    cells = [c for t in results.tables for row in t.rows for c in row if isinstance(c, Score)]
    points = [score for c in results.curves for line in c.lines for _, score in line.points]
    evidence = [score for claim in results.claims for score in claim.evidence]
    return [*results.scores, *cells, *points, *evidence]


def repeat(call: Call, file: Path, progress: Progress = quiet) -> Again:
    """Make a call of a file again; a call that cannot be made gives the reason."""
    try:
        module, name = FUNCTIONS[call.verb]
    except KeyError:
        return Again(call, None, f"palpate {call.verb} is no verb that can be verified"[:200])
    try:
        with reading_entry(file, f"The call of palpate {call.verb}"):
            arguments = {name: _decoded(value) for name, value in call.arguments.items()}
            result = getattr(import_module(module), name)(**arguments, progress=progress)
    except (PalpateError, OSError) as error:
        return Again(call, None, " ".join(str(error).split()))
    return Again(call, result)


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
        if not is_there(path):
            raise PalpateError("An input must exist", f"nothing at {path}", "Put it there again")
        if ROWS in value:
            from palpate.data.reading import load

            if (manifest := load(path)).digest != value[ROWS]:
                must, got = f"{path} must hold the samples of the call", "other samples"
                raise PalpateError(must, got, "Save the samples that were passed")
            return manifest
        return path
    if isinstance(value, Mapping):
        return {key: _decoded(item) for key, item in value.items()}
    return [_decoded(item) for item in value] if isinstance(value, list) else value


def input_checks(again: Again) -> list[Check]:
    """Files by the digests of the call's arguments, and what was read of them by its result."""
    call, checks = again.call, list[Check]()
    of = f"of palpate {call.verb}"
    for name, value in _paths(call.arguments):
        path, digest = Path(str(value[PATH])), value.get(DIGEST)
        shown = f"{name.replace('_', ' ')} {path} {of}"
        if not is_there(path):
            checks.append(Check(shown, "cannot check", f"nothing at {path}", "input"))
        elif digest is not None:
            now = digest_of(path, name)
            checks.append(_digest_check(shown, str(digest), now))
    for name, digest in call.digests.items():
        shown = f"{name} {of}"
        if again.result is None:
            checks.append(Check(shown, "cannot check", again.reason, "input"))
        else:
            now = next((c.digests.get(name) for c in _calls_of(again.result)), None)
            checks.append(_digest_check(shown, digest, now))
    return checks


def _digest_check(name: str, before: str, after: str | None) -> Check:
    if before == after:
        return Check(name, "same", kind="input")
    now = "nothing" if after is None else f"SHA-256 {after[:12]}"
    return Check(name, "differs", f"SHA-256 {before[:12]} in the file, {now} now", "input")


def _calls_of(result: Results | Audit) -> list[Call]:
    if isinstance(result, Results):
        return [*result.calls]
    return [] if result.call is None else [result.call]


def _paths(value: Any, name: str = "") -> list[tuple[str, Mapping[str, Any]]]:
    """(argument, record) of every file in the arguments of a call."""
    if isinstance(value, Mapping):
        if PATH in value:
            return [(name, value)]
        return [pair for key, item in value.items() for pair in _paths(item, name or str(key))]
    if isinstance(value, list):
        return [pair for item in value for pair in _paths(item, name)]
    return []


def _score_checks(scores: Sequence[Score], made: Sequence[Again], tolerance: float) -> list[Check]:
    again: dict[str, list[Score]] = {}
    for result in (a.result for a in made if isinstance(a.result, Results)):
        for score in result.scores:
            again.setdefault(score_name(score), []).append(score)
    listed = {id(score) for group in again.values() for score in group}
    checks: list[Check] = []
    for score in scores:
        name = score_name(score)
        differences = {
            id(other): score_difference(score, other, tolerance) for other in again.get(name, ())
        }
        equal = [key for key, difference in differences.items() if not difference]
        listed -= {*(equal or differences)}
        if equal:
            checks.append(Check(name, "same"))
        elif differences:
            checks.append(Check(name, "differs", next(iter(differences.values()))))
        else:
            checks.append(_unmade(name, made, Results))
    gone = [score for group in again.values() for score in group if id(score) in listed]
    return checks + [
        Check(score_name(score), "differs", f"not in the file, {float(score):.8g} now")
        for score in gone
    ]


def _unmade(name: str, made: Sequence[Again], kind: type) -> Check:
    """A number that no call gives: of a call that cannot be made, if there is one."""
    of_audit = kind is Audit
    reasons = [a.reason for a in made if a.result is None and (a.call.verb == "audit") == of_audit]
    if reasons:
        return Check(name, "cannot check", "; ".join(dict.fromkeys(reasons)))
    return Check(name, "untraced", NO_CALL)


def _audit_checks(audits: Sequence[Audit], made: Sequence[Again], tolerance: float) -> list[Check]:
    """Every number of every audit; one among the others of another is of that one's call."""
    by_call = {id(a.call): a for a in made}
    others = [other for audit in audits if audit.call is not None for other in audit.others]
    checks: list[Check] = []
    for audit in audits:
        if audit.call is None and audit in others:
            continue
        again = None if audit.call is None else by_call[id(audit.call)]
        start = f"audit {audit.name}: " if audit.name else "audit: "
        before = audit_numbers(audit, start)
        if again is None or not isinstance(again.result, Audit):
            reason = NO_CALL if again is None else again.reason or "its call makes no audit"
            status: Status = "cannot check" if again is not None and again.reason else "untraced"
            checks += [Check(name, status, reason) for name in before]
            continue
        after = audit_numbers(again.result, start)
        for name in dict.fromkeys([*before, *after]):
            why = number_difference(before.get(name), after.get(name), tolerance)
            checks.append(Check(name, "differs" if why else "same", why))
    return checks


def _fact_checks(facts: Iterable[str], made: Sequence[Again]) -> list[Check]:
    """The sentences with numbers that stand above the tables."""
    known = {f for a in made if isinstance(a.result, Results) for f in a.result.facts}
    numbered = [fact for fact in facts if any(c.isdigit() for c in fact)]
    return [
        Check(f"fact {fact[:60]!r}", "same")
        if fact in known
        else _unmade(f"fact {fact[:60]!r}", made, Results)
        for fact in numbered
    ]


def _strip_checks(strips: Sequence[Strip], made: Sequence[Again], tolerance: float) -> list[Check]:
    """What an encoder retrieved for some queries: similarities and ranks."""
    results = [a.result for a in made if isinstance(a.result, Results)]
    again = {_strip_name(strip): strip for result in results for strip in result.strips}
    checks: list[Check] = []
    for strip in strips:
        name = _strip_name(strip)
        if name not in again:
            checks.append(_unmade(name, made, Results))
            continue
        why = number_difference(plain(strip), plain(again[name]), tolerance)
        checks.append(Check(name, "differs" if why else "same", why))
    return checks


def _strip_name(strip: Strip) -> str:
    of = f" of {strip.subject}" if strip.subject else ""
    return f"retrieved {strip.keys} for {strip.queries} {strip.query.id}{of}"


def _distinct(checks: Sequence[Check]) -> list[Check]:
    """Each check once: a number may stand in several tables."""
    return list(dict.fromkeys(checks))
