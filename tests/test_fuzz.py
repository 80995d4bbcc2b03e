"""Commands on valid inputs succeed; on thousands of broken ones they end as the fuzzer allows."""

import pytest

from fuzz import cases, seeds
from fuzz.workers import run

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz") / "base"
    seeds.build(folder)
    return folder


def test_every_command_of_the_fuzzer_works_on_whole_inputs(base, tmp_path):
    for number, command in enumerate(seeds.COMMANDS):
        folder = tmp_path / str(number)
        args = cases.prepare(command, base, folder)
        status, _, err = cases.run(args, folder)
        # The demo is given data without images: it stops before its minutes of training.
        assert status in ((2,) if command.startswith("demo") else (0, 1, 3)), (command, err[-500:])


@pytest.mark.parametrize(
    ("first", "end"), [(0, 100), pytest.param(100, 2000, marks=pytest.mark.nightly)]
)
def test_broken_inputs_end_in_one_line(first, end, base):
    results = run(range(first, end), seed=0, base=base)
    wrong = [(number, *rest) for number, *rest in results if rest[-1]]
    assert not wrong, wrong[:5]
