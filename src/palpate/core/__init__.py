"""What every room uses. Importing it loads NumPy, no other library.

- ``messages``: errors (``PalpateError``, raised by ``require``), notes, problems of the input,
  progress; ``few`` and ``problem_lines`` shorten lists for them.
- ``files``: files that are whole or absent (``atomic_path``, ``write_json``), and read with checks
  (``read_json``, ``read_record``); digests (``short``: their first digits); random numbers of a
  sample (``rng_for``). ``sealed`` and ``unsealed`` add and check an object's own digest, ``inside``
  checks that a path stays in its root, ``got_and_fix`` says in an error what palpate wrote there.
- ``caches``: files that palpate reads back, each with its digest next to it.
- ``images``: image files, opened in one way and by fixed rules.
- ``features``, ``score``: what metrics compare, and what they return.
- ``split``: which samples are of train, val and test.
"""

from palpate.core.caches import cached, is_whole, sealed_path
from palpate.core.features import FeatureSet
from palpate.core.files import (
    atomic_folder,
    atomic_path,
    content_of,
    digest_file,
    digest_folder,
    digest_json,
    digest_lines,
    fact_lines,
    got_and_fix,
    inside,
    locked,
    plain,
    read_json,
    read_record,
    reading_entry,
    require_new_folder,
    require_regular,
    rng_for,
    sealed,
    seed_for,
    short,
    unsealed,
    write_json,
    write_text,
)
from palpate.core.images import ImageError, decoded, image_bytes, open_image, save_image
from palpate.core.messages import (
    MissingExtraError,
    Note,
    PalpateError,
    PalpateWarning,
    Problem,
    ProblemsError,
    Progress,
    SampleRef,
    few,
    fields_of,
    problem_lines,
    quiet,
    require,
    require_choice,
    track,
)
from palpate.core.score import Measure, Score, require_comparable
from palpate.core.split import NO_LEAK, PARTS, Split

__all__ = [
    "NO_LEAK",
    "PARTS",
    "FeatureSet",
    "ImageError",
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
    "cached",
    "content_of",
    "decoded",
    "digest_file",
    "digest_folder",
    "digest_json",
    "digest_lines",
    "fact_lines",
    "few",
    "fields_of",
    "got_and_fix",
    "image_bytes",
    "inside",
    "is_whole",
    "locked",
    "open_image",
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
    "save_image",
    "sealed",
    "sealed_path",
    "seed_for",
    "short",
    "track",
    "unsealed",
    "write_json",
    "write_text",
]
