"""A server of the Model Context Protocol: assistants ask about logs, the fleet and vehicles (docs/mcp.md).

quoted.py     texts of others (logs, file names), marked as data
folders.py    which files may be read
models.py     the answers as types: the schema that a client sees
series.py     a few samples of what a picture shows
answers.py    diagnosis, log and vehicle -> short answers
store.py      the fleet's store -> short answers
work.py       what the processes with limits do
desk.py       takes a question, has it answered within the limits
tools.py      the tools, with their parameters
resources.py  glossary and limits
access.py     who may ask over HTTP
server.py     all of it on standard input and output, or on a port
"""

from rotorwatch.assistants.server import mcp

__all__ = ["mcp"]
