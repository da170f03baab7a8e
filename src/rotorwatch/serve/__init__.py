"""One page for vehicles while they fly and for flights afterwards (docs/serve.md).

names.py      names of uploaded files, made harmless
security.py   access: token, host, origin; what a browser may do with the answers
hub.py        numbered messages to all open pages
live.py       the watch loop, and what the page shows of it
flights.py    the list of flights: the fleet's store, and a page for each
landed.py     a flight that was watched and has ended, for the list
uploads.py    logs that are sent here, judged in processes with limits
comparison.py  the page of two flights next to each other
pages.py      the files of the page (folder page/)
connections.py  how long a connection may be without a request, and how many there are
app.py        the routes
server.py     all of it on a port
"""

from rotorwatch.serve.server import serve

__all__ = ["serve"]
