"""Chains to one frame: closed forms, and searches in machine code."""
