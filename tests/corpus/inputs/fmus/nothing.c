/* A library without the functions of FMI. */
int nothing(void) { return 0; }
