"""Chains and trees: closed forms, and goals, descents and searches in machine code."""
