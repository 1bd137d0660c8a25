"""Rigid bodies in a tree: frames, recursions and solves over generic scalars."""
