/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#define PX4_OK 0
#define PX4_ERROR (-1)
#define __EXPORT
int px4_log(const char *format, ...);
#define PX4_INFO(...) px4_log(__VA_ARGS__)
#define PX4_WARN(...) px4_log(__VA_ARGS__)
#define PX4_ERR(...) px4_log(__VA_ARGS__)
#define PRINT_MODULE_DESCRIPTION(text) px4_log(text)
#define PRINT_MODULE_USAGE_NAME(name, category) px4_log(name)
#define PRINT_MODULE_USAGE_COMMAND(name) px4_log(name)
#define PRINT_MODULE_USAGE_DEFAULT_COMMANDS() px4_log("")
template <class T> class ModuleBase
{
public:
	virtual ~ModuleBase() = default;
	virtual int print_status() { return 0; }
	static int main(int, char *[]) { return 0; }

protected:
	struct Object {
		void store(T *) {}
	};
	static Object _object;
	static int _task_id;
	static constexpr int task_id_is_work_queue = -2;
	bool should_exit() const { return false; }
	void exit_and_cleanup() {}
};
template <class T> typename ModuleBase<T>::Object ModuleBase<T>::_object;
template <class T> int ModuleBase<T>::_task_id = -1;
