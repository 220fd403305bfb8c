"""The demonstration behind ``osik demo``: NAO's two motions."""
