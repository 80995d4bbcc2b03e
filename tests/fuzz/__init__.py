"""Commands on damaged inputs: valid files, broken at random from a seed and a case's number.

``python -m tests.fuzz --cases 20000 --seed 1`` runs many, ``--seed 1 --case 1234`` one again.
``seeds.py`` has the valid inputs and commands, ``mutations.py`` breaks them, ``cases.py`` runs a
case and says what is wrong with how it ended, ``__main__.py`` shares cases among processes.
"""
