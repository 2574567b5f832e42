"""Looking a dataset over before training: what is in it, what is wrong, which frames to distrust.

`gsgan.check.run.check_data` is the way in; every other module is one question asked of the data.
"""
