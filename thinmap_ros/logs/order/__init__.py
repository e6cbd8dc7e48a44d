"""Order of the events of a log: clocks that jump, late messages, scans that are not used."""
