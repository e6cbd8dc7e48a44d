"""The command line: dispatch to commands and verbs, error messages and exit codes."""

import importlib
import os
import signal
import sys

from ros2_shim.verbs import Parser, ShimError, Verb

# Each is a module beside this one, imported on demand.
COMMANDS = {
    'action': 'list actions, send goals',
    'interface': 'show the fields of a type',
    'lifecycle': 'states of lifecycle nodes',
    'node': 'list nodes and their topics, services and actions',
    'param': 'parameters of running nodes',
    'pkg': 'packages and their programs',
    'run': 'run a program of a package',
    'service': 'list and call services',
    'topic': 'list topics, show and publish messages',
}
# Of the real one: what they need, that the Python wheels of ROS do not have.
ELSEWHERE = {
    'security': 'SROS 2 needs a ROS 2 Jazzy with the package ros-jazzy-sros2; '
    'the Fast DDS of the Python wheels is built without security',
}
SMALL = "thinmap's small ros2 for machines without ROS"


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
        print(_one_line(failure), file=sys.stderr)
    except RuntimeError as error:
        # Errors of rclpy and of the middleware.
        print(f'ros2: {_one_line(error)}', file=sys.stderr)
    return 1


def _one_line(error: Exception) -> str:
    return ' '.join(str(error).split())


def _command(words: list[str]) -> int:
    if not words or words[0] in ('-h', '--help'):
        print(f'usage: ros2 COMMAND ...\n\n{SMALL}. Commands:')
        _table(COMMANDS)
        print('\nros2 COMMAND -h: its verbs')
        return 0
    if words[0] in ELSEWHERE:
        print(f'ros2: no command {words[0]}: {ELSEWHERE[words[0]]}', file=sys.stderr)
        return 2
    if words[0] not in COMMANDS:
        return _unknown('ros2', 'command', words[0], COMMANDS)
    if words[0] == 'run':
        module = importlib.import_module('ros2_shim.pkg')
        module.run(words[1:])
        return 0
    return _verb(words[0], words[1:])


def _verb(command: str, words: list[str]) -> int:
    verbs: dict[str, Verb] = importlib.import_module(f'ros2_shim.{command}').VERBS
    if not words or words[0] in ('-h', '--help'):
        print(f'usage: ros2 {command} VERB ...\n\n{SMALL}: {COMMANDS[command]}. Verbs:')
        _table({name: verb.help for name, verb in verbs.items()})
        return 0
    if words[0] not in verbs:
        return _unknown(f'ros2 {command}', 'verb', words[0], verbs)
    verb = verbs[words[0]]
    parser = Parser(prog=f'ros2 {command} {words[0]}', description=verb.help, allow_abbrev=False)
    verb.arguments(parser)
    verb.main(parser.parse_args(words[1:]))
    return 0


def _table(lines: dict[str, str]) -> None:
    width = max(len(name) for name in lines)
    for name, text in lines.items():
        print(f'  {name:{width}}  {text}')


def _unknown(program: str, kind: str, word: str, known: dict[str, str] | dict[str, Verb]) -> int:
    has = ', '.join(known)
    print(f'{program}: no {kind} {word}: this is {SMALL}; it has {has}', file=sys.stderr)
    return 2
