"""The demonstration behind ``osik demo``: NAO's two motions, and their runs in physics."""
