"""What the commands of studies do: imported when they are used, for it imports JAX and much else."""
