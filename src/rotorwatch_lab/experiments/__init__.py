"""Accuracy of rotorwatch's diagnoses: known faults in, answers counted. campaign/ does the same on simulated flights.

tools.py            shares and rates with intervals, tables, parts done in processes
counting.py         what is found, right, late, and a false alarm: one definition
limits.py           the best that any method could do
known_losses.py     what it asks of ticks whose losses are known, as a definition
inject.py           losses put into healthy flights
labels.py           lists of flights whose faults are known
rival_detector.py   somebody's own detector beside rotorwatch, for evaluate
evaluate.py         the diagnosis on them, scored
evaluation_page.py  its answer as a page
real_flights/       labels and tables of real flights in public repositories
imbalance.py        unbalances put into flights, and simulated ones
studies/            comparisons, false alarms, and the experiments of the papers
research_tables.py  their results in the terminal
"""
