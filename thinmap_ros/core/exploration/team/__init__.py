"""Exploration by several robots, which share the candidates by what each claims."""
