"""Rig files that come with Pantograph."""
