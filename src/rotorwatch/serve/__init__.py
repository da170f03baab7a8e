"""A web page for vehicles while they fly and for flights afterwards (docs/serve.md).

names.py        sanitised names of uploaded files
security.py     access: token, host, origin; security headers of the answers
hub.py          numbered messages to all open pages
live.py         the watch loop, and its data for the page
flights.py      the list of flights: the fleet's store, and a page for each
landed.py       a watched flight that has ended, for the list
uploads.py      uploaded logs, assessed in processes with limits
comparison.py   the page of two flights side by side
pages.py        the files of the page (folder page/)
connections.py  limits on idle connections and on their number
app.py          the routes
server.py       all of it on a port
"""

from rotorwatch.serve.server import serve

__all__ = ["serve"]
