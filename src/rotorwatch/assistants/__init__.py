"""A server of the Model Context Protocol: assistants ask about logs, the fleet and vehicles (docs/mcp.md).

quoted.py     foreign texts (logs, file names), marked as data
folders.py    the readable files
models.py     the answers as types: the schema for clients
signal_rows.py samples of a plot's time series
answers.py    diagnosis, log and vehicle -> short answers
fleet_access.py the fleet's store -> short answers
work.py       the jobs of the processes with limits
desk.py       dispatches a question to a process with limits
mcp_tools.py  the tools, with their parameters
resources.py  glossary and limits
access.py     access control over HTTP
mcp_server.py all of it on standard input and output, or on a port
"""

from rotorwatch.assistants.mcp_server import mcp

__all__ = ["mcp"]
