"""Fixtures of the tests of the solve."""

import numpy as np
import pytest


@pytest.fixture(scope="session")
def solver():
    from gsgan.body import free_body
    from gsgan.body.solve import Solver

    return Solver(free_body())


@pytest.fixture(scope="session")
def poses():
    """Of a motion that signs and makes fists, on which no setting was tuned."""
    from gsgan.synthetic.free_subject import free_character, free_pose
    from gsgan.synthetic.posing import Choreography

    motion = Choreography(free_character(), seed=11)
    return free_pose(motion.at(np.arange(0.4, motion.duration, 0.5)))
