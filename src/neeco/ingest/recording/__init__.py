"""What a recording consists of: recording.yaml and the files it names."""
