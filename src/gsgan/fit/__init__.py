"""The body fitted to a capture: its shape, and its pose registered to masks."""
