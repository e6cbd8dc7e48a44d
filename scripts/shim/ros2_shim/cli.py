"""The command line: dispatch to commands and verbs, error messages and exit codes."""

import importlib
import os
import signal
import sys
from collections.abc import Iterable

from ros2_shim import pkg
from ros2_shim.verb import ShimError, Verb

# Each but `run` is a module beside this one, imported on demand.
COMMANDS = {
    'action': 'send goals',
    'lifecycle': 'transitions of lifecycle nodes',
    'param': 'parameters of running nodes',
    'pkg': 'folders of packages',
    'run': 'run a program of a package',
    'service': 'call services',
    'topic': 'list topics, show their messages',
}
# Of the real one: what they need, that the Python wheels of ROS do not have.
ELSEWHERE = {
    'security': 'SROS 2 needs a ROS 2 Jazzy with the package ros-jazzy-sros2; '
    'the Fast DDS of the Python wheels is built without security',
}
SMALL = "thinmap's small ros2 for machines without ROS"
HELP = ('-h', '--help')


def main(words: list[str]) -> int:
    """Run a command line; returns the exit code."""
    try:
        return _command(words)
    except KeyboardInterrupt:
        return int(signal.SIGINT)
    except BrokenPipeError:
        # The reader of the pipe has ended. Python would fail when it flushes stdout at its exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except ShimError as failure:
        return _fail(str(failure), 1)
    except RuntimeError as error:
        # Errors of rclpy and of the middleware.
        return _fail(f'ros2: {error}', 1)


def _fail(text: str, code: int) -> int:
    print(' '.join(text.split()), file=sys.stderr)
    return code


def _command(words: list[str]) -> int:
    command = words[0] if words else '-h'
    if command in HELP:
        _show_help('ros2 COMMAND', f'{SMALL}. Commands', COMMANDS)
        print('\nros2 COMMAND -h: its verbs')
        return 0
    if command in ELSEWHERE:
        return _fail(f'ros2: no command {command}: {ELSEWHERE[command]}', 2)
    if command not in COMMANDS:
        return _unknown(f'ros2 {command}', COMMANDS)
    if command == 'run':
        pkg.RUN.run('ros2 run', words[1:])
        return 0
    return _verb(command, words[1:])


def _verb(command: str, words: list[str]) -> int:
    verbs: dict[str, Verb] = importlib.import_module(f'ros2_shim.{command}').VERBS
    verb = words[0] if words else '-h'
    if verb in HELP:
        texts = {name: each.help for name, each in verbs.items()}
        _show_help(f'ros2 {command} VERB', f'{SMALL}: {COMMANDS[command]}. Verbs', texts)
        return 0
    program = f'ros2 {command} {verb}'
    if verb not in verbs:
        return _unknown(program, verbs)
    verbs[verb].run(program, words[1:])
    return 0


def _show_help(usage: str, title: str, texts: dict[str, str]) -> None:
    print(f'usage: {usage} ...\n\n{title}:')
    width = max(len(name) for name in texts)
    for name, text in texts.items():
        print(f'  {name:{width}}  {text}')


def _unknown(program: str, known: Iterable[str]) -> int:
    return _fail(f'{program}: not in this ros2: expected one of {", ".join(known)}', 2)
