#!/bin/sh
# Six tasks with two FMUs, Tank.fmu and Controller.fmu, and a log, e1.xlsx, in this folder. Take your own in their place.
set -e

# 1. Two FMUs: three variations, their comparison, the signal browser
cosim init Tank.fmu Controller.fmu --out tanks.yaml
cosim run tanks.yaml
cosim run tanks.yaml --set Controller.gain=0.1
cosim run tanks.yaml --set Controller.gain=0.2
cosim compare 1 2 3
cosim view

# 2. A log from Excel: the error of the FMU, its parameters, the effect that it lacks
cosim replay e1.xlsx --fmu Tank.fmu
cosim fit e1.xlsx --fmu Tank.fmu
cosim refine results/e1/0001/study.yaml

# 3. A sweep: how many runs meet the criteria, and which factors matter
cosim sweep sweep.yaml

# 4. The system as an SSP for other tools, and back
cosim export-ssp tanks.yaml
cosim run Tank_Controller.ssp

# 5. A run in a live page, and its signals
cosim run tanks.yaml --live
cosim view Tank_Controller

# 6. A script; tanks.ipynb is a notebook
python script.py
