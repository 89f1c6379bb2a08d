"""HTML pages, each one file without anything to fetch, and their figures."""
