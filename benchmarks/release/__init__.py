"""All results of a release in one run that can be interrupted."""
