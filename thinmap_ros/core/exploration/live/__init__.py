"""What an exploration on a robot needs beside its strategy: graph, view and drives."""
