"""Constants of nature."""

G0 = 9.80665  # m/s^2, standard gravity
