"""palpate: from a photo to the touch it would give, and honest scores for how well.

Importing this package has no effects and loads neither torch nor polars; import the room you need
(``palpate.data``, ``palpate.leakage``, ``palpate.metrics`` ...).
"""

__version__ = "0.1.0.dev0"
