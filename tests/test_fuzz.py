"""Commands on valid inputs succeed; on thousands of broken ones they end as the fuzzer allows."""

import shlex

import pytest

from fuzz import seeds
from fuzz.workers import run
from palpate.cli import VERBS

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]
nightly = pytest.mark.nightly


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz") / "base"
    seeds.build(folder)
    return folder


@nightly
def test_every_command_of_the_fuzzer_works_on_whole_inputs(base):
    wrong = [result for result in run([*seeds.COMMANDS], seed=0, base=base) if result[-1]]
    assert not wrong, wrong[:5]


def test_without_extras_every_verb_works_or_says_which_it_lacks(base):
    """``palpate VERB`` where no package of an extra can be imported; twenty broken inputs there."""
    commands = [*seeds.COMMANDS, *seeds.BARE]
    words = [" ".join(shlex.split(command)[:2]) for command in commands]
    verbs = {w if w in VERBS else w.partition(" ")[0] for w in words}
    assert verbs == {*VERBS}
    jobs = [*commands, *range(20)]
    wrong = [each for each in run(jobs, seed=0, workers=1, base=base, bare=True) if each[-1]]
    assert not wrong, wrong[:5]


@nightly
@pytest.mark.parametrize(("first", "end", "bare"), [(20, 500, True), (0, 2000, False)])
def test_broken_inputs_end_in_one_line(first, end, bare, base):
    results = run(range(first, end), seed=0, base=base, bare=bare)
    wrong = [(number, *rest) for number, *rest in results if rest[-1]]
    assert not wrong, wrong[:5]
