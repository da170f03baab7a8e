"""One plug-in of each kind for rotorwatch. Copy the folder, change the names, keep what you need."""
