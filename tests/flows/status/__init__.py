"""A sweep, looked at and stopped from outside."""
