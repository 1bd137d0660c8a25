"""Why goals cannot be met, and what proves it."""
