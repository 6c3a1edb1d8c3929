"""The service that owns the headset's devices: it shows the pictures of programs at the display's times.

Process of the service:

supervisor             starts everything, checks the signs of life, reports to systemd and Prometheus
connected_programs     requests of programs and their answers (program_session, frame_calls)
frame_pipeline         accepted frames on their way to the panel
solver_client          the solver's process, as the supervisor knows it
camera_client          the camera's process, as the supervisor knows it
display_thread         the panel
laser_heartbeat        the lasers
refinement_captures    captures of the displayed picture for a refinement

Child processes (child_processes starts them; process_messages is what they exchange with the supervisor):

solver_process         pictures to patterns (frame_solver, refinement_client)
refinement_process     a picture that is refined, a child of the solver's
camera_process         the camera and its library

For programs:

protocol               the messages of programs and the service; hololoop_service.h is the same for C
client                 what a Python program uses
"""
