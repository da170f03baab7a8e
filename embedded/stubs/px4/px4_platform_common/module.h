/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <px4_platform_common/atomic.h>
#include <px4_platform_common/log.h>
#include <string.h>
#ifdef STUB_PX4_1_17
class ModuleBase
{
public:
	struct Descriptor {
		Descriptor(int (*ts)(int, char **), int (*cc)(int, char **), int (*pu)(const char *))
			: task_spawn(ts), custom_command(cc), print_usage(pu) {}
		int (*task_spawn)(int argc, char *argv[]);
		int (*custom_command)(int argc, char *argv[]);
		int (*print_usage)(const char *reason);
		px4::atomic<ModuleBase *> object{nullptr};
		int task_id{-1};
	};
	ModuleBase() = default;
	virtual ~ModuleBase() = default;
	static int main(Descriptor &desc, int argc, char *argv[])
	{
		if (argc > 1 && strcmp(argv[1], "start") == 0) { return desc.task_spawn(argc - 1, argv + 1); }

		if (argc > 1 && strcmp(argv[1], "stop") == 0) {
			if (desc.object.load() != nullptr) { desc.object.load()->request_stop(); }

			return 0;
		}

		if (argc > 1 && strcmp(argv[1], "status") == 0) { return desc.object.load() ? desc.object.load()->print_status() : -1; }

		return desc.custom_command(argc - 1, argv + 1);
	}
	static void exit_and_cleanup(Descriptor &desc)
	{
		delete desc.object.load();
		desc.object.store(nullptr);
		desc.task_id = -1;
	}
	static bool is_running(const Descriptor &desc) { return desc.task_id != -1; }
	virtual void run() {}
	virtual int print_status() { return 0; }
	virtual void request_stop() { _task_should_exit.store(true); }
	bool should_exit() const { return _task_should_exit.load(); }
	static constexpr int task_id_is_work_queue = -2;

protected:
	px4::atomic_bool _task_should_exit{false};
};
#else
template <class T> class ModuleBase
{
public:
	ModuleBase() : _task_should_exit{false} {}
	virtual ~ModuleBase() {}
	static int main(int argc, char *argv[])
	{
		if (argc > 1 && strcmp(argv[1], "start") == 0) { return T::task_spawn(argc - 1, argv + 1); }

		if (argc > 1 && strcmp(argv[1], "stop") == 0) {
			if (_object.load() != nullptr) { static_cast<ModuleBase<T> *>(_object.load())->request_stop(); }

			return 0;
		}

		if (argc > 1 && strcmp(argv[1], "status") == 0) { return _object.load() ? _object.load()->print_status() : -1; }

		return T::custom_command(argc - 1, argv + 1);
	}
	virtual int print_status() { return 0; }
	virtual void run() {}
	static bool is_running() { return _task_id != -1; }

protected:
	virtual void request_stop() { _task_should_exit.store(true); }
	bool should_exit() const { return _task_should_exit.load(); }
	static void exit_and_cleanup()
	{
		delete _object.load();
		_object.store(nullptr);
		_task_id = -1;
	}
	static T *get_instance() { return _object.load(); }
	static px4::atomic<T *> _object;
	static int _task_id;
	static constexpr const int task_id_is_work_queue = -2;

private:
	px4::atomic_bool _task_should_exit;
};
template <class T> px4::atomic<T *> ModuleBase<T>::_object{nullptr};
template <class T> int ModuleBase<T>::_task_id = -1;
#endif
__BEGIN_DECLS
__EXPORT void PRINT_MODULE_DESCRIPTION(const char *description);
__EXPORT void PRINT_MODULE_USAGE_NAME(const char *executable_name, const char *category);
__EXPORT void PRINT_MODULE_USAGE_COMMAND_DESCR(const char *name, const char *description);
__END_DECLS
#define PRINT_MODULE_USAGE_COMMAND(name) PRINT_MODULE_USAGE_COMMAND_DESCR(name, nullptr);
#define PRINT_MODULE_USAGE_DEFAULT_COMMANDS() \
	PRINT_MODULE_USAGE_COMMAND("stop"); \
	PRINT_MODULE_USAGE_COMMAND_DESCR("status", "");
