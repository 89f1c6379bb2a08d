"""Interactive viewer: in a browser, served from here, or exported to one file."""
