"""Shared by every room: settings checked, plug-ins found, files and streams within limits, libraries that may be missing."""
