"""Shared by all rooms: errors, files, work on all cores, options and output of commands."""
