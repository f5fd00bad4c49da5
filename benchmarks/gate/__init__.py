"""How often the gate lets a wrong alignment through, and how often it refuses a right one."""
