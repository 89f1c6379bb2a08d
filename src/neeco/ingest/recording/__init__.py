"""Recordings: recording.yaml and the files it names."""
