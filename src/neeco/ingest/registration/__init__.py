"""Where trackers, robots' bases and clocks stand to the cameras."""
