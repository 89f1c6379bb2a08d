"""Self-contained HTML pages, one file each, and their figures."""
