"""Stamps: nanoseconds since 1970. Messages of ROS hold the seconds in 32 bits with a sign."""

SECOND_NS = 1_000_000_000
CLOCK_JUMP_NS = SECOND_NS  # a clock that steps back by more was set back
LATEST_S = 2**31  # in 2038
LATEST_NS = LATEST_S * SECOND_NS
