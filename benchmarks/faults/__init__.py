"""A live graph under random faults: see scripts/endurance --faults."""
