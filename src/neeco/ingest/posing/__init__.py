"""Roll and joints of instruments whose shaft was found in a video, from its images and from hand-posed frames."""
