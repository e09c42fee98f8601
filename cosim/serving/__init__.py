"""FMUs of this machine for masters on other machines."""
