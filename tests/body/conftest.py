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
    from mannequin import choreography

    from gsgan.synthetic.free_subject import free_character, free_pose

    motion = choreography(free_character())
    return free_pose(motion.at(np.arange(0.4, motion.duration, 0.5)))
