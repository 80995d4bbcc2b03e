"""What a bad input is answered with."""

import pytest

from palpate.core import PalpateError


class Bomb:
    """Fails the test when it is unpickled."""

    def __reduce__(self):
        return pytest.fail, ("unpickled",)


def fails(words, function, *args, **options):
    """The error of a call, whose message must match ``words``."""
    with pytest.raises(PalpateError, match=words or None) as caught:
        function(*args, **options)
    return caught.value
