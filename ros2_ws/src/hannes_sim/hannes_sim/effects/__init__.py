"""The catalogue: one physical effect a file; every module here is found by hannes_sim.effect.catalogue()."""
