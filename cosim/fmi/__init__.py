"""FMI variables, slaves, model descriptions and FMU builds."""
