"""Fixtures of the tests of the solve."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[2] / "scripts"))


@pytest.fixture(scope="session")
def solver():
    from gsgan.body import free_body
    from gsgan.body.solve import Solver

    return Solver(free_body())


@pytest.fixture(scope="session")
def poses():
    """Of a motion that signs and makes fists, on which no setting was tuned.

    The generator bends fingers about the body's own hinges; a file's motion turns them aside too.
    """
    from motions.posing import Choreography

    from gsgan.synthetic.free_subject import free_character, free_pose

    motion = Choreography(free_character(), seed=11)
    return free_pose(motion.at(np.arange(0.4, motion.duration, 0.5)))
