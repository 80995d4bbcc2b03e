"""The vocabulary that every room shares; needs NumPy alone."""

from palpate.core.digest import (
    digest_file,
    digest_folder,
    digest_json,
    digest_lines,
    fact_lines,
    plain,
    rng_for,
    seed_for,
    short,
)
from palpate.core.errors import (
    MissingExtraError,
    PalpateError,
    PalpateWarning,
    Problem,
    ProblemsError,
    few,
    fields_of,
    problem_lines,
    require,
    require_choice,
)
from palpate.core.features import FeatureSet
from palpate.core.files import (
    atomic_folder,
    atomic_path,
    inside,
    locked,
    read_json,
    read_record,
    reading_entry,
    require_new_folder,
    require_regular,
    write_json,
    write_text,
)
from palpate.core.notes import Note
from palpate.core.progress import Progress, quiet, track
from palpate.core.samples import SampleRef
from palpate.core.score import Measure, Score, require_comparable
from palpate.core.split import PARTS, Split

__all__ = [
    "PARTS",
    "FeatureSet",
    "Measure",
    "MissingExtraError",
    "Note",
    "PalpateError",
    "PalpateWarning",
    "Problem",
    "ProblemsError",
    "Progress",
    "SampleRef",
    "Score",
    "Split",
    "atomic_folder",
    "atomic_path",
    "digest_file",
    "digest_folder",
    "digest_json",
    "digest_lines",
    "fact_lines",
    "few",
    "fields_of",
    "inside",
    "locked",
    "plain",
    "problem_lines",
    "quiet",
    "read_json",
    "read_record",
    "reading_entry",
    "require",
    "require_choice",
    "require_comparable",
    "require_new_folder",
    "require_regular",
    "rng_for",
    "seed_for",
    "short",
    "track",
    "write_json",
    "write_text",
]
