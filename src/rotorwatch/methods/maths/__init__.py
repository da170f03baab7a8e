"""Mathematics shared by several methods, and the plants they run on (systems/). Independent of logs."""
