"""Parameters of slam_toolbox, AMCL, explore_lite and Nav2 that thinmap's nodes understand."""
