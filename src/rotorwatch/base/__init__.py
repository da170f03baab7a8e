"""Shared infrastructure: checks of settings, plug-in discovery, files and streams within limits, optional libraries."""
