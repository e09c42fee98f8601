"""FMUs of the worked example, the thrust-vectoring hovercraft: variables and recipes."""

FMU_PACKAGES = ("plant", "controller", "fmus")  # packages included in an FMU of the example if imported by its slave
