"""The service that owns the headset's devices: programs hand it pictures, it shows them by the display's clock.

supervisor       the service's own process: sockets and programs (sessions, frames), metrics, systemd
pipeline         from an accepted frame to the panel (display), through the solver's process
lighting         the lasers and their heartbeat
eye              the camera's process, as the supervisor sees it
solver_process   pictures to patterns (solving)
camera_process   the camera and its library
protocol         what programs and the service say; hololoop_service.h is the same for C
client           what a program uses
"""
