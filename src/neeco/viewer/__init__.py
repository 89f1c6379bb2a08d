"""The scene to look at and steer: in a browser, served from here, or in one file."""
