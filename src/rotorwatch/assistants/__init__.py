"""A server of the Model Context Protocol: assistants ask about logs, the fleet and vehicles (docs/mcp.md).

quoted.py     foreign texts (logs, file names), marked as data
folders.py    the readable files
models.py     the answers as types: the schema for clients
series.py     samples of a plot's time series
answers.py    diagnosis, log and vehicle -> short answers
store.py      the fleet's store -> short answers
work.py       the jobs of the processes with limits
desk.py       dispatches a question to a process with limits
tools.py      the tools, with their parameters
resources.py  glossary and limits
access.py     access control over HTTP
server.py     all of it on standard input and output, or on a port
"""

from rotorwatch.assistants.server import mcp

__all__ = ["mcp"]
