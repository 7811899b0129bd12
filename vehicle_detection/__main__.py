"""``python -m vehicle_detection`` runs the command line."""

from vehicle_detection.cli import main

if __name__ == "__main__":
    main()
