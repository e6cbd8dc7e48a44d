"""Where a robot is that was switched on anywhere in a finished map."""
