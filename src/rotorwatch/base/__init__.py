"""What every room stands on: settings checked, plug-ins found, files and streams within limits, libraries that may be missing."""
