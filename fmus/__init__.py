"""FMUs of the worked example, the thrust-vectoring hovercraft: their variables and recipes."""

PACKAGES = ("plant", "controller", "fmus")  # carried by an FMU of the example, as far as its slave imports them
