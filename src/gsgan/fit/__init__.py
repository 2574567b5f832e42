"""Skeletons moved so that the person fits the masks of all cameras."""
