"""Registration of trackers, robots' bases and clocks to the cameras."""
