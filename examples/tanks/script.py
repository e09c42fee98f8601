"""Two runs of the tanks in Python: signals as arrays, their comparison, a figure."""

import cosim

slow = cosim.run("tanks.yaml")
firm = cosim.run("tanks.yaml", set={"Controller.gain": 0.1})
print(f"{slow['Tank.level'][-1]:.3f} m, {firm['Tank.level'][-1]:.3f} m")
print(cosim.compare(slow, firm))
firm.plot("Tank.level").savefig("level.png")
